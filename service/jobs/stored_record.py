"""The record of a job of fast or setpoint, rebuilt from its stored samples: for another Ms, or for a plot."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.service.store.sample_blocks import COLUMNS, Block
from loopwright.tuning.analysis.pv_faults import without_wrong_samples
from loopwright.tuning.fast.evaluation.record_evaluation import first_period
from loopwright.tuning.fast.manual.procedure import MANUAL
from loopwright.tuning.fast.record import MIN_LISTENED, MIN_SWITCHES, Excitation, ExperimentRecord, oscillation_period
from loopwright.tuning.models import Reals
from loopwright.tuning.plan import Mode

MIN_TURNS = 2
"""Smallest number of turns of the set-point for a fit."""
MAX_RAMP_GAP = 12
"""Number of samples between two moves of the set-point in one direction, from which on they are no ramp: a simulated
plant at full speed takes the commands of ten samples at once."""
AWAY = 1e-3
"""Distance from home at which MV is away in a pulse of the manual output, as a part of its range."""
Columns = Mapping[str, Sequence[Any] | Reals]
"""Columns by their names in GET /jobs/{id}/samples."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredRecord:
    """The samples of the last attempt of a job.

    Ts: the sample time, s.
    t: time since the relay or the pulses began, s.
    sp, pv, mv: as recorded, in PV and MV units.
    listened, excited: number of samples before the relay or the pulses, and up to their end.
    switches: the samples at which the relay switched, or the set-point or the manual output turned.
    excitation: what moved the loop.
    """

    Ts: float
    t: Reals
    sp: Reals
    pv: Reals
    mv: Reals
    listened: int
    excited: int
    switches: tuple[int, ...]
    excitation: Excitation

    @property
    def rest(self) -> tuple[float, float]:
        """Returns MV and PV at rest."""
        return float(np.mean(self.mv[: self.listened])), float(np.mean(self.right_pv[: self.listened]))

    @property
    def right_pv(self) -> Reals:
        """Returns PV without its single wrong samples, as the job took them out, in PV units."""
        return without_wrong_samples(self.pv)

    def experiment_record(self) -> ExperimentRecord | None:
        """Returns the record for a fit; None where the relay has not switched often enough."""
        relay = self.excitation is Excitation.RELAY
        if len(self.switches) < (MIN_SWITCHES if relay else MIN_TURNS) or self.listened < MIN_LISTENED:
            return None
        mv, pv = self.rest
        u, y = self.mv - mv, self.right_pv - pv
        excited = slice(self.listened, self.excited)
        return ExperimentRecord(
            Ts=self.Ts,
            u=u,
            y=y,
            direction=self._direction,
            listened=self.listened,
            excited=self.excited,
            turns=len(self.switches),
            period=oscillation_period(self.switches) if relay else first_period(u[excited], y[excited], self.Ts),
            steps=tuple(int(i) for i in self.excited + moves_of(self.sp[self.excited - 1 :]) - 1),
            excitation=self.excitation,
            one_sided=not relay and self._to_one_side,
        )

    @property
    def _to_one_side(self) -> bool:
        """Whether the pulses went to one side of where they began only."""
        moved = self.mv if self.excitation is Excitation.MANUAL else self.sp
        away = moved[self.listened : self.excited] - moved[0]
        return bool(np.all(away >= 0.0) or np.all(away <= 0.0))

    @property
    def _direction(self) -> float:
        """+1 where PV rises with MV, else -1."""
        if self.excitation is Excitation.MANUAL:  # PV may answer its first pulses not at all, or after their ends
            return self._correlated_direction
        # each begins with a move of MV, and turns after PV has moved in the direction in which MV drives it
        rises_first = self.excitation is Excitation.RELAY or self._rises_with_setpoint
        return 1.0 if (self.pv[self.switches[0]] > self.rest[1]) == rises_first else -1.0

    @property
    def _correlated_direction(self) -> float:
        """The sign of the largest cross-correlation of MV with a later PV during the excitation."""
        excited, count = slice(self.listened, self.excited), 2 * (self.excited - self.listened)
        u, y = (np.fft.rfft(each[excited] - np.mean(each[excited]), count) for each in (self.mv, self.pv))
        later = np.fft.irfft(y * np.conj(u), count)[: count // 2]
        return math.copysign(1.0, later[np.argmax(np.abs(later))])

    @property
    def _rises_with_setpoint(self) -> bool:
        """Whether MV has risen with the first move of the set-point."""
        mv, _ = self.rest
        return bool(np.mean(self.mv[self.listened : self.switches[0]]) > mv)


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """The samples of the last attempt of a job. Missing samples are filled: PV is interpolated, the rest held.

    Ts: the sample time, s.
    taken: the places of the samples that are not missing, from 0.
    sp, pv, mv, mode, stage: as recorded.
    """

    Ts: float
    taken: NDArray[np.int64]
    sp: Reals
    pv: Reals
    mv: Reals
    mode: Reals
    stage: NDArray[np.str_]


def last_attempt(columns: Columns) -> Attempt | None:
    """Returns the last attempt of these columns; None where it has less than two samples."""
    stages = columns["stage"]
    first = max(
        (i for i, name in enumerate(stages) if name == "preflight" and stages[max(i - 1, 0)] != name), default=0
    )
    t, sp, pv, mv, mode = (np.asarray(columns[name][first:], dtype=float) for name in ("t_s", "sp", "pv", "mv", "mode"))
    stage = np.asarray(stages[first:], dtype=str)
    if len(t) < 2:
        return None
    Ts = float(np.median(np.diff(t)))
    number = np.round((t - t[0]) / Ts).astype(np.int64)
    whole = np.arange(number[-1] + 1)
    before = np.searchsorted(number, whole, side="right") - 1
    return Attempt(Ts, number, sp[before], np.interp(whole, number, pv), mv[before], mode[before], stage[before])


def stored_record(columns: Columns) -> StoredRecord | None:
    """Returns the record of these columns; None where neither a relay nor pulses were run."""
    attempt = last_attempt(columns)
    return None if attempt is None else record_of(attempt)


def record_of(attempt: Attempt) -> StoredRecord | None:
    """Returns the record of an attempt; None where neither a relay nor pulses were run."""
    sp, mv, mode, stage, Ts = attempt.sp, attempt.mv, attempt.mode, attempt.stage, attempt.Ts
    if np.any(mode == Mode.EXPERIMENT):
        excitation, parts = Excitation.RELAY, _of_relay(mv, mode, sp, stage)
    elif np.any(np.diff(sp[stage == "pulses"])):
        excitation, parts = Excitation.SETPOINT, _of_pulses(sp, stage)
    elif np.any(np.diff(mv[stage == MANUAL])):
        excitation, parts = Excitation.MANUAL, _of_manual(mv)
    else:
        return None
    listened, excited, switches = parts
    t: Reals = (np.arange(len(sp), dtype=np.float64) - listened) * Ts
    return StoredRecord(Ts, t, sp, attempt.pv, mv, listened, excited, switches, excitation)


def record_columns(blocks: Iterable[Block]) -> Columns:
    """Returns all samples as one array for each column, 48 bytes a sample, for computations."""
    stages: list[str] = []
    numbers: dict[str, list[Reals]] = {column: [np.empty(0)] for column in COLUMNS}
    for block in blocks:
        stages += [block.stage] * block.count
        for column in COLUMNS:
            numbers[column].append(block.values(column))
    return {"stage": stages} | {column: np.concatenate(found) for column, found in numbers.items()}


def moves_of(sp: Reals) -> NDArray[np.int64]:
    """Returns the samples at which the set-point begins to move, each ramp once."""
    change = np.diff(sp)
    moved = np.flatnonzero(change)
    apart, way = np.diff(moved, prepend=-MAX_RAMP_GAP), np.sign(change[moved])
    first: NDArray[np.int64] = moved[(apart >= MAX_RAMP_GAP) | (np.diff(way, prepend=0.0) != 0.0)]
    return first + 1


Parts = tuple[int, int, tuple[int, ...]]
"""The number of samples at rest, that up to the end of the excitation, and the samples of its turns."""


def _of_relay(mv: Reals, mode: Reals, sp: Reals, stage: NDArray[np.str_]) -> Parts:
    begun = int(np.argmax(mode == Mode.EXPERIMENT))
    after = np.flatnonzero(mode[begun:] != Mode.EXPERIMENT)
    excited = begun + int(after[0]) if len(after) else len(mode)
    # the relay may follow pulses of the set-point, which belong to the same record
    pulses = moves_of(sp[:begun])
    listened = int(pulses[0]) if np.any(stage[:begun] == "pulses") and len(pulses) else begun
    # the relay begins high
    high = np.append(True, mv[begun:excited] > np.mean(mv[: max(listened, 1)]))
    return listened, excited, tuple(int(i) + begun for i in np.flatnonzero(high[1:] != high[:-1]))


def _of_pulses(sp: Reals, stage: NDArray[np.str_]) -> Parts:
    moved = moves_of(sp)
    verified = [int(i) for i in moved if stage[i] == "verify"]
    excited = verified[0] if verified else len(sp)
    return int(moved[0]), excited, tuple(int(i) for i in moved[1:] if i < excited)


def _of_manual(mv: Reals) -> Parts:
    away = np.abs(mv - mv[0]) > AWAY * float(np.ptp(mv))
    turned = np.flatnonzero(away[1:] != away[:-1]) + 1
    return int(turned[0]), len(mv), tuple(int(i) for i in turned[1:])
