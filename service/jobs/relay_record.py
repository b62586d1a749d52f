"""The record of a fast experiment, rebuilt from the stored samples of its job: for another Ms, or for a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopwright.tuning.fast.record import MIN_LISTENED, MIN_SWITCHES, ExperimentRecord, oscillation_period
from loopwright.tuning.models import Reals
from loopwright.tuning.plan import Mode

Columns = Mapping[str, Sequence[Any] | Reals]
"""Columns by their names in GET /jobs/{id}/samples."""


@dataclass(frozen=True, slots=True, eq=False)
class RelayRecord:
    """The samples of the last attempt of a job.

    Ts: the sample time, s.
    t: time since the relay began, s.
    sp, pv, mv: as recorded, in PV and MV units.
    listened, relayed: number of samples before the relay, and up to its end.
    switches: the samples at which the relay switched.
    """

    Ts: float
    t: Reals
    sp: Reals
    pv: Reals
    mv: Reals
    listened: int
    relayed: int
    switches: tuple[int, ...]

    @property
    def rest(self) -> tuple[float, float]:
        """Returns MV and PV at rest."""
        return float(np.mean(self.mv[: self.listened])), float(np.mean(self.pv[: self.listened]))

    def experiment_record(self) -> ExperimentRecord | None:
        """Returns the record for a fit; None where the relay has not switched often enough."""
        if len(self.switches) < MIN_SWITCHES or self.listened < MIN_LISTENED:
            return None
        mv, pv = self.rest
        y = self.pv - pv
        return ExperimentRecord(
            Ts=self.Ts,
            u=self.mv - mv,
            y=y,
            # the relay begins high, and switches after PV has moved in the direction in which MV drives it
            direction=1.0 if y[self.switches[0]] > 0.0 else -1.0,
            listened=self.listened,
            excited=self.relayed,
            turns=len(self.switches),
            period=oscillation_period(self.switches),
            steps=tuple(int(i) for i in self.relayed + np.flatnonzero(np.diff(self.sp[self.relayed - 1 :]))),
        )


def relay_record(columns: Columns) -> RelayRecord | None:
    """Returns the record of these columns; None where no relay was run."""
    stage = columns["stage"]
    first = max((i for i, name in enumerate(stage) if name == "preflight" and stage[max(i - 1, 0)] != name), default=0)
    t, sp, pv, mv, mode = (np.asarray(columns[name][first:], dtype=float) for name in ("t_s", "sp", "pv", "mv", "mode"))
    if len(t) < 2 or not np.any(mode == Mode.EXPERIMENT):
        return None
    Ts = float(np.median(np.diff(t)))
    # missing samples are filled: PV interpolated, the rest held
    number = np.round((t - t[0]) / Ts).astype(np.int64)
    whole = np.arange(number[-1] + 1)
    before = np.searchsorted(number, whole, side="right") - 1
    pv = np.interp(whole, number, pv)
    sp, mv, mode = sp[before], mv[before], mode[before]
    listened = int(np.argmax(mode == Mode.EXPERIMENT))
    after = np.flatnonzero(mode[listened:] != Mode.EXPERIMENT)
    relayed = listened + int(after[0]) if len(after) else len(mode)
    # the relay begins high
    high = np.append(True, mv[listened:relayed] > np.mean(mv[: max(listened, 1)]))
    switches = tuple(int(i) + listened for i in np.flatnonzero(high[1:] != high[:-1]))
    return RelayRecord(Ts, (whole - listened) * Ts, sp, pv, mv, listened, relayed, switches)
