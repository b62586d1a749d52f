"""The model on which accepted gains were designed, and what it says of a stretch of operation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.analysis.zero_order_hold import pulses
from loopwright.tuning.fast.design.design import controller
from loopwright.tuning.fast.design.uncertainty import filter_ratio
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Complexes, Reals, TransferFunction, monic, sign

GAIN_KNOWN, DEAD_TIME_KNOWN, SPEED_KNOWN = 0.03, 0.02, 0.05
"""What is known of a model without a covariance, in standard deviations: its gain, as a fraction; its dead time, in
ultimate periods; the factor of all its time constants, as a fraction."""
GRID = (0.02, 3.0, 1500)
"""Lowest and highest frequency, in 2 pi over the ultimate period, and number of frequencies, evenly spaced, at which Ms
is computed: a second path turns the loop once in its delay."""
MAX_MS = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class AcceptedModel:
    """A model and the gains that were accepted for it.

    plant: the plant, without the delay of the sampling.
    gains: the gains in effect since they were accepted.
    period_s: the ultimate period of the plant, s.
    sampling_delay_s: the delay of the sampling, s.
    covariance: the covariance of num, of den without its leading 1 and of the dead time, in this order, with den[0] = 1
    and times in s; None where it is not known.
    """

    plant: TransferFunction
    gains: Gains
    period_s: float
    sampling_delay_s: float
    covariance: Sequence[Sequence[float]] | None = None

    def neighbours(self) -> list[tuple[TransferFunction, float]]:
        """Plants that differ from the model by what is not known of it, each with its distance from the model in
        standard deviations; the directions are independent of each other."""
        return list(self._of_covariance() if self.covariance is not None else self._of_any())

    def _of_any(self) -> list[tuple[TransferFunction, float]]:
        plant, speed = self.plant, 1.0 + SPEED_KNOWN
        powers = speed ** np.arange(len(plant.den) - 1, -1, -1.0)
        slower = TransferFunction(
            tuple(np.asarray(plant.num) * powers[-len(plant.num) :] / powers[0]),
            tuple(np.asarray(plant.den) * powers / powers[0]),
            plant.L,
        )
        larger = replace(plant, num=tuple((1.0 + GAIN_KNOWN) * each for each in plant.num))
        later = replace(plant, L=plant.L + DEAD_TIME_KNOWN * self.period_s)
        return [(larger, 1.0), (later, 1.0), (slower, 1.0)]

    def _of_covariance(self) -> list[tuple[TransferFunction, float]]:
        num, den = self.plant.num, self.plant.den
        at = np.array([*num, *den[1:], self.plant.L])
        covariance = np.asarray(self.covariance, dtype=np.float64)
        size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        scale = np.where(size > 0.0, size, 1.0)
        variances, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
        found = []
        for variance, direction in zip(variances, directions.T, strict=True):
            if variance <= 0.0:
                continue
            move = np.sqrt(variance) * scale * direction
            # far from the model the answer is no longer proportional to the distance
            with np.errstate(divide="ignore"):
                distance = float(min(1.0, np.min(0.1 * np.abs(at[at != 0.0]) / np.abs(move[at != 0.0]))))
            moved = at + distance * move
            plant = TransferFunction(
                tuple(moved[: len(num)]), (den[0], *moved[len(num) : -1]), max(float(moved[-1]), 0.0)
            )
            found.append((plant, distance))
        return found

    def Ms(self, share: float = 0.0, path_s: float = 0.0, gain: float = 1.0, later_s: float = 0.0) -> float:
        """Ms of the accepted gains on the model, or on a plant that differs from it; MAX_MS at most.

        share, path_s: a second path has this part of the gain of the model, and acts so much later, s.
        gain: the ratio of the gain to that of the model. later_s: by how much the dead time is longer, s.
        """
        low, high, points = GRID
        w = np.linspace(low, high, points) * 2.0 * np.pi / self.period_s
        delay = max(self.plant.L + self.sampling_delay_s + later_s, 0.0)
        plant = replace(self.plant, L=delay).frequency_response(w) * gain
        plant = plant * (1.0 + share * np.exp(-1j * w * path_s))
        gains = self.gains
        loop: Complexes = gains.Kp * controller(w, gains.Ti, gains.Td, filter_ratio(gains)) * sign(self.plant) * plant
        return float(min(1.0 / np.min(np.abs(1.0 + loop)), MAX_MS)) if np.all(np.isfinite(loop)) else MAX_MS


def driven(plant: TransferFunction, u: Reals, Ts: float, further_s: float = 0.0) -> Reals:
    """What a plant that is at rest at first makes of MV, as deviations, shape (N,).

    u: MV as a deviation, held from each sample to the next, shape (N,). Ts: the sample time, s.
    further_s: a further dead time, s.
    """
    num, den = _in_samples(plant, Ts)
    order = len(den) - 1
    delay = max((plant.L + further_s) / Ts, 0.0)
    states = pulses(den[None, 1:], [delay], order).drive(u)[0]
    answer = states @ (num[1:] - num[0] * den[1:])[::-1]
    if num[0]:
        late = int(delay) + 1
        answer[late:] += num[0] * u[: len(u) - late]
    return np.asarray(answer)


def answers_to_step(plant: TransferFunction, samples: int, Ts: float) -> Reals:
    """The states of a plant after a step at its input, without its dead time, each in its largest value, shape
    (samples, order): they represent any start that is not at rest, and any load that steps."""
    _, den = _in_samples(plant, Ts)
    states = pulses(den[None, 1:], [0.0], len(den) - 1).drive(np.ones(samples))[0]
    return np.asarray(states / np.maximum(np.max(np.abs(states), axis=0), 1e-300))


def _in_samples(plant: TransferFunction, Ts: float) -> tuple[Reals, Reals]:
    """Numerator and denominator of the same length, the latter beginning with 1, times in samples."""
    num, den = monic(plant)
    powers = Ts ** np.arange(len(den))
    return np.asarray(num * powers), np.asarray(den * powers)
