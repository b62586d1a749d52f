"""From what an observation found to a plant that a procedure may take as known."""

from __future__ import annotations

import numpy as np

from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.models import Reals
from loopwright.tuning.operation.observation import Observation


def known_plant(found: Observation, sample_time_s: float, age_s: float) -> ObservedPlant | NothingKnown:
    """The known plant, where the observation is good enough to propose gains.

    sample_time_s: the sample time of the controller, s. age_s: the plant time since the latest set-point change, s.
    """
    if found.reason is not None or found.evaluation is None:
        return NothingKnown(found.detail)
    if found.valve is not None:
        return NothingKnown(f"the plant is known behind {found.valve.in_words}, and a trial moves MV in front of it")
    evaluation, used = found.evaluation, found.used
    record = evaluation.fit.record
    return ObservedPlant(
        record=record,
        together=max(1, round(record.Ts / sample_time_s)),
        gains=used[-1].stretch.gains,
        pv=_range([each.stretch.pv[each.samples] for each in used]),
        mv=_range([each.stretch.mv[each.samples] for each in used]),
        age_s=age_s,
        source=f"{len(used)} set-point changes of normal operation, from which Ms is known to +-{found.known_to:.2g}",
    )


def _range(columns: list[Reals]) -> tuple[float, float]:
    return float(min(map(np.min, columns))), float(max(map(np.max, columns)))
