"""Three seeded, deterministic optimisers search for the minimum of a criterion in the unit square (or cube).

A criterion takes many points at once, shape (p, n), and gives the values, shape (p,); it must be finite everywhere.

    multi_epoch_swarm        Romasevych and Loveikin's swarm with restarts
    differential_evolution   scipy's
    nelder_mead              scipy's, from the best of many random points
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize

from loopwright.tuning.models import Reals

Cost = Callable[[Reals], Reals]


@dataclass(frozen=True, slots=True)
class SearchResult:
    """The result of a search.

    point: the best point, shape (n,).
    value: the criterion there.
    evaluations: the number of points evaluated.
    epochs: the number of starts of the search.
    """

    point: Reals
    value: float
    evaluations: int
    epochs: int = 1


def multi_epoch_swarm(
    cost: Cost,
    dimensions: int,
    seed: int,
    particles: int = 50,
    iterations: int = 50,
    social: float = 2.1,
    cognitive: float = 0.1,
    acceptable_rate: float = 0.1,
) -> SearchResult:
    """The multi-epoch particle swarm (ME-PSO): x + cognitive*r1*(own best - x) + social*r2*(best of all - x), without
    velocity, clipped to the square.

    When an iteration lowers the best of all by no more than the fraction acceptable_rate, all particles are placed at
    random again and lose their own bests; the best of all stays. The search takes particles*iterations evaluations.
    Source: "PI-controller tuning optimization via PSO-based technique", equations (8) to (10) and the parameter table,
    read by the text: the larger coefficient belongs to the best of all, and (10), which as printed always holds, means
    the relative reduction. New particles first move, then are evaluated; r1 and r2 are drawn for each coordinate. The
    paper states neither.
    """
    rng = np.random.default_rng(seed)
    shape = (particles, dimensions)
    at = rng.random(shape)
    value = cost(at)
    own, own_value = at, value
    best, best_value = at[np.argmin(value)], float(value.min())
    epochs = 1
    for _ in range(iterations - 1):
        at = at + cognitive * rng.random(shape) * (own - at) + social * rng.random(shape) * (best - at)
        at = np.clip(at, 0.0, 1.0)
        value = cost(at)
        better = value < own_value
        own, own_value = np.where(better[:, None], at, own), np.where(better, value, own_value)
        before = best_value
        if float(value.min()) < best_value:
            best, best_value = at[np.argmin(value)], float(value.min())
        if before - best_value <= acceptable_rate * abs(best_value):
            at = rng.random(shape)
            own, own_value = at, np.full(particles, np.inf)
            epochs += 1
    return SearchResult(best, best_value, particles * iterations, epochs)


def differential_evolution(cost: Cost, dimensions: int, seed: int, budget: int = 2500) -> SearchResult:
    """scipy's differential evolution with generations of 25 points per dimension, each evaluated at once, and at most
    `budget` points."""
    population, evaluations = 25 * dimensions, 0

    def generation(x: Reals, /) -> Any:
        nonlocal evaluations
        evaluations += x.shape[1]
        return cost(x.T)

    found = optimize.differential_evolution(
        generation,
        optimize.Bounds(np.zeros(dimensions), np.ones(dimensions)),
        popsize=25,
        maxiter=budget // population - 1,
        tol=1e-8,
        seed=np.random.default_rng(seed),
        polish=False,
        updating="deferred",
        vectorized=True,
    )
    return SearchResult(np.asarray(found.x), float(found.fun), evaluations)


def nelder_mead(cost: Cost, dimensions: int, seed: int, budget: int = 2500, starts: int = 10) -> SearchResult:
    """scipy's Nelder-Mead from the best distinct ones of budget/5 random points, then once more from the best result.

    starts: the largest number of starts.
    """
    scattered: Reals = np.random.default_rng(seed).random((budget // 5, dimensions))
    values = cost(scattered)
    left = scattered[np.argsort(values)]
    evaluations = len(scattered)
    each = (budget - evaluations) // (starts + 1)

    def one(x: Reals) -> float:
        return float(cost(x[None, :])[0])

    def search(start: Reals, size: float) -> SearchResult:
        inwards = np.where(start < 0.5, size, -size)
        simplex = start + np.concatenate((np.zeros((1, dimensions)), inwards * np.eye(dimensions)))
        found = optimize.minimize(
            one,
            start,
            method="Nelder-Mead",
            bounds=optimize.Bounds(np.zeros(dimensions), np.ones(dimensions)),
            options={"initial_simplex": simplex, "xatol": 1e-6, "fatol": 1e-6, "maxfev": each},
        )
        return SearchResult(np.asarray(found.x), float(found.fun), int(found.nfev))

    runs: list[SearchResult] = []
    while len(runs) < starts and len(left):
        runs.append(search(left[0], 0.05))
        left = left[np.abs(left - left[0]).max(axis=1) > 0.05]
    best = min(runs, key=lambda run: run.value)
    # a simplex can collapse on a cliff; a small new one frees it
    again = search(best.point, 0.01)
    evaluations += sum(run.evaluations for run in runs) + again.evaluations
    best = min(best, again, key=lambda run: run.value)
    return SearchResult(best.point, best.value, evaluations, len(runs) + 1)
