"""What the plant gets in place of the MV that the controller gives, as far as a record shows it: an MV that moves no
faster than a rate, is switched on and off in a window, or is taken in steps.

The model is fitted to what the plant would get then. A fault is believed where it explains the record, and better than
any model of a sound actuator, another fault of a valve or a gain that changes does: those look alike under a few moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.analysis.window import PHASES, lengths, switched
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.score_tests.score_tests import ScoreTests, above_rest, cubed, squared
from loopwright.tuning.fast.score_tests.two_lags import find_two_lags
from loopwright.tuning.fast.score_tests.valve_faults import Fault, backlash, saturation, stiction
from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN, by_bic, fit_structures
from loopwright.tuning.identification.output_error import UNDISTURBED, Fit, Fitted
from loopwright.tuning.identification.structures import SECOND, SECOND_WITH_ZERO, THIRD, Structure
from loopwright.tuning.models import Reals

RATE_RATIO = 1.12
SLOWEST, FASTEST = 1.5, 2.0
"""Times that MV's largest move takes at the slowest rate that is tried, in periods, and at the fastest, in samples."""
FINEST, COARSEST, STEP_PHASES = 0.07, 1.2, 8
"""The finest and the coarsest step of MV that is tried, as parts of MV's largest move, and how many places of the first
step."""
LONGEST_WINDOW = 0.7
"""Of the windows that are tried, in periods."""
SIZES = 1.25 ** np.arange(-17, 0)
"""Sizes of other faults of a valve that are tried, as parts of MV's largest move."""
SHARES = (-0.6, -0.4, -0.25, -0.15, -0.1, -0.05, 0.05, 0.1, 0.15, 0.25, 0.4, 0.6, 1.0, 2.0)
"""By how much a gain that changes may do so."""
OTHER_FAULTS: dict[str, Fault] = {"backlash": backlash, "stiction": stiction, "saturation": saturation}
OTHER_CHANGES = {"above rest": above_rest, "squared": squared, "cubed": cubed}
"""What else may explain a record, and is not named here."""
APART = {"steps": 3, "window": 4}
"""How many of its neighbours in the list of sizes are left out beside one that is fitted."""
LEFT = 0.05
"""Smallest part of MV's largest move that a fault leaves."""
BEGUN = 3
"""How many sizes of a kind that is named are refined; of another kind the best one is."""
CLEAR = 4.0
"""By how much a fault has to lower chi-squared in a score test to be fitted."""
FITTED, REFINED = 8, 6
"""How many sizes of each kind are fitted, and how often the best is refined."""
STRUCTURES: tuple[Structure, ...] = (SECOND, SECOND_WITH_ZERO, THIRD)
STEPS = 8
RIVAL = {"rate": 15.0, "window": 30.0, "steps": 60.0}
"""By how much BIC of each kind of fault must be below that of any other kind: the more ways there are to place it, the
more of what else is in a record it can stand for."""
EXPLAINED = 1.6, 0.006
"""Largest residual by which a fault explains the record: in standard deviations of the noise at rest, or as a part of
PV's range. A sound actuator has to leave less (`evaluation`): what is said here is a reason, no model."""


@dataclass(frozen=True, slots=True)
class MvFault:
    """What the plant gets in place of MV.

    what: in words, with its size. bic_gain: by how much it lowers BIC below the best model of a sound actuator.
    """

    what: str
    bic_gain: float


@dataclass(frozen=True, slots=True)
class _MvFit:
    """A fault of one size: what it makes of MV in the record.

    kind: of the fault. size: what `_near` refines. u: MV units,
    shape (N,).
    """

    kind: str
    size: tuple[float, ...]
    u: Reals


def find_mv_fault(fit: Fit[ExperimentRecord], best: Fitted, mv_at_rest: float) -> MvFault | None:
    """What the plant gets in place of MV, None where the record does not show it.

    best: the best model without such a fault. mv_at_rest: MV units.
    """
    record = fit.record
    if len(record.pieces) > 1:
        return None
    # a structure that jumps with MV, or a poor minimum, may not know a fault that another one shows
    of = [ScoreTests(fit, each) for each in (best, *fit_structures(fit, UNDISTURBED, structures=(SECOND,)))]
    named = [
        _refined(record, mv_at_rest, some, BEGUN)
        for kind in _kinds(record, mv_at_rest)
        if (some := _likely(of, record, kind))
    ]
    if not named:
        return None
    (found, fault), *others = sorted(named, key=lambda each: each[0].bic)
    noises, of_range = EXPLAINED
    explained = found.rms <= max(noises * record.noise / record.output_range, of_range)
    gain, clear = best.bic - found.bic, found.bic + RIVAL[fault.kind]
    if not explained or gain < MIN_BIC_GAIN or any(each.bic < clear for each, _ in others):
        return None
    for kind in _other_kinds(record):
        if (some := _likely(of, record, kind)) and _refined(record, mv_at_rest, some, 1)[0].bic < clear:
            return None
    # a lag that is another one while PV falls is named by the evaluation, before this
    lags = find_two_lags(fit, best)
    if lags is not None and lags.bic_gain > gain - RIVAL[fault.kind]:
        return None
    return MvFault(_in_words(fault, record), gain)


def _likely(of: Sequence[ScoreTests], record: ExperimentRecord, kind: Iterator[_MvFit]) -> list[_MvFit]:
    """The sizes of one kind that score tests of these models find the likeliest; none where none is likely."""
    tried = [each for each in kind if _moves(each, record)]
    if not tried:
        return []
    changed = np.array([each.u for each in tried]) - record.u
    scored = (tests.scores(changed) for tests in of)
    decrease = np.max([(2.0 * shares - 1.0) / np.square(deviations) for shares, deviations in scored], axis=0)
    ranked = np.argsort(-decrease).tolist()
    if not decrease[ranked[0]] > CLEAR:
        return []
    name = tried[0].kind
    some = [tried[i] for i in _distinct(ranked, APART.get(name, 1))]
    # the score test of a large fault says little of its size
    return some + (tried[::3] if name == "rate" else [])


def _kinds(record: ExperimentRecord, mv_at_rest: float) -> Iterator[Iterator[_MvFit]]:
    """Every size of each kind that is named."""
    move = float(np.ptp(record.u))
    count = math.log(max(SLOWEST * record.period / FASTEST, 1.0)) / math.log(RATE_RATIO)
    slowest = move / (SLOWEST * record.period)
    yield (_rate(record, slowest * RATE_RATIO**k) for k in range(round(count)))
    steps = move / np.arange(1.0 / COARSEST, 1.0 / FINEST, 0.25)
    yield (_steps(record, step, step * k / STEP_PHASES) for step in steps.tolist() for k in range(STEP_PHASES))
    yield (
        each
        for length in lengths(record.y[: record.listened], record.Ts, LONGEST_WINDOW * record.period)
        for k in range(PHASES)
        for each in _window(record, mv_at_rest, length, length * k / PHASES)
    )


def _other_kinds(record: ExperimentRecord) -> Iterator[Iterator[_MvFit]]:
    """Every size of each kind that is not named here."""
    for name in OTHER_FAULTS:
        yield (_other(record, name, size) for size in SIZES)
    for name in OTHER_CHANGES:
        yield (_other(record, name, share) for share in SHARES)


def _refined(record: ExperimentRecord, mv_at_rest: float, some: Sequence[_MvFit], many: int) -> tuple[Fitted, _MvFit]:
    """The best fit of one kind, and its size, refined from so many of these sizes."""
    thetas: dict[Structure, Reals] = {}

    def fitted(each: _MvFit, structures: Sequence[Structure] = (SECOND,)) -> Fitted:
        moved = Fit(replace(record, u=each.u))
        if structures[0] in thetas and len(structures) == 1:
            return moved.search(structures[0], UNDISTURBED, [thetas[structures[0]]], STEPS)
        return min(fit_structures(moved, UNDISTURBED, structures=structures), key=by_bic)

    begun = sorted(((fitted(each), each) for each in some), key=lambda each: each[0].bic)[:many]
    ended = []
    for found, fault in begun:
        thetas[SECOND] = found.theta
        finer = 1.0
        for _ in range(REFINED):
            before = fault
            for each in _near(record, mv_at_rest, fault, finer):
                again = fitted(each) if _moves(each, record) else found
                if again.bic < found.bic:
                    found, fault = again, each
                    thetas[SECOND] = found.theta
            if fault is before:
                finer *= 0.4
        ended.append((found, fault))
    found, fault = min(ended, key=lambda each: each[0].bic)
    last = fitted(fault, STRUCTURES)
    return (last if last.bic < found.bic else found), fault


def _moves(tried: _MvFit, record: ExperimentRecord) -> bool:
    """Whether the fault leaves something of MV's moves."""
    return float(np.max(np.abs(tried.u))) > LEFT * record.input_range


def _distinct(ranked: Sequence[int], apart: int) -> list[int]:
    """The likeliest sizes, as many as are fitted, none within `apart` of another."""
    kept: list[int] = []
    for i in ranked:
        if all(abs(i - k) > apart for k in kept):
            kept.append(i)
        if len(kept) == FITTED:
            break
    return kept


def _near(record: ExperimentRecord, mv_at_rest: float, fault: _MvFit, finer: float) -> Iterator[_MvFit]:
    """Sizes near one."""
    if fault.kind == "rate":
        (rate,) = fault.size
        yield from (_rate(record, rate * RATE_RATIO ** (sign * finer * 0.7)) for sign in (-1.0, 1.0))
    elif fault.kind == "steps":
        step, first = fault.size
        move = float(np.ptp(record.u))
        for turned in (-finer, finer):
            yield _steps(record, move / (move / step + 0.12 * turned), first)
            yield _steps(record, step, first + turned * step / STEP_PHASES / 2.0)
    elif fault.kind in OTHER_FAULTS or fault.kind in OTHER_CHANGES:
        (size,) = fault.size
        yield from (_other(record, fault.kind, size * 1.25 ** (sign * finer * 0.5)) for sign in (-1.0, 1.0))
    elif fault.kind == "window":
        length, begin = fault.size
        turned = length / PHASES * finer
        off = length**2 / len(record.u) / 4.0 * finer
        for more, later in ((0.0, turned), (0.0, -turned), (off, 0.0), (-off, 0.0)):
            yield from _window(record, mv_at_rest, length + more, begin + later)


def _other(record: ExperimentRecord, name: str, size: float) -> _MvFit:
    """A fault of the valve of this size, a part of MV's largest move, or a gain that changes so much."""
    if name in OTHER_FAULTS:
        scale = record.input_range
        return _MvFit(name, (size,), scale * OTHER_FAULTS[name](record.u / scale, size))
    return _MvFit(name, (size,), record.u + size * OTHER_CHANGES[name](record))


def _rate(record: ExperimentRecord, rate: float) -> _MvFit:
    """rate: MV units a sample. The mean over each sample of where such an actuator is."""
    at, found = float(record.u[0]), []
    for value in record.u.tolist():
        way = min(max(value - at, -rate), rate)
        # it arrives within the sample where the way is shorter than the rate
        found.append(at + way * (1.0 - 0.5 * abs(way) / rate))
        at += way
    return _MvFit("rate", (rate,), np.array(found))


def _steps(record: ExperimentRecord, step: float, first: float) -> _MvFit:
    """first: a level, MV units from rest."""
    u = step * np.round((record.u - first) / step)
    return _MvFit("steps", (step, first), np.asarray(u - np.mean(u[: record.listened])))


def _window(record: ExperimentRecord, mv_at_rest: float, length: float, begin: float) -> Iterator[_MvFit]:
    """length, begin: samples."""
    for latched in (True, False):
        mv = switched(record.u + mv_at_rest, length, begin, latched)
        if mv is not None:
            yield _MvFit("window", (length, begin), mv - mv_at_rest)


def _in_words(fault: _MvFit, record: ExperimentRecord) -> str:
    if fault.kind == "rate":
        rate = fault.size[0] / record.Ts
        asked, reached = float(np.max(np.abs(record.u))), float(np.max(np.abs(fault.u)))
        text = f"MV moves no faster than about {rate:.2g} a second on its way to the plant"
        return f"{text}: of {asked:.3g} away from rest it reached {reached:.3g}" if reached < 0.98 * asked else text
    if fault.kind == "steps":
        return f"MV reaches the plant in steps of about {fault.size[0]:.2g}"
    return f"MV is switched on and off in a window of {fault.size[0] * record.Ts:.3g} s"
