"""The model of a loop that is known before a test: entered, found by an earlier test or in operation, or read off the
record of a test that ended as PV left its limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.planning.expected import LoopModel
from loopwright.service.planning.found_model import DISPROVED, found_model
from loopwright.service.states.loop_state import loop_state
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.tuning.experiments.preflight import PREFLIGHT
from loopwright.tuning.fast.manual.procedure import MANUAL
from loopwright.tuning.fast.pulses.levels import RESTED, candidate_models
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.structures import INTEGRATOR
from loopwright.tuning.models import Integrating, Model, Reals
from loopwright.tuning.plan import Sample
from loopwright.tuning.reasons import Reason, Refused

LOOKED_AT = 5
"""Number of the latest tests that are searched."""
MOVING = ("baseline", "pulses", "relay", MANUAL)
"""The stages that move the loop first."""
MIN_SAMPLES = 10
SHOWS = 5.0
"""Standard deviations of its noise from which on a deviation of PV is more than that."""


def loop_model(
    store: Store, knowledge: KeptKnowledge, config: LoopConfig, request: RetuneRequest, gains: Gains | None
) -> LoopModel | None:
    """Returns the model that tells how far a test will move PV; None where nothing is known. Raises SQLAlchemyError.

    gains: the gains in effect; None where they are not known.
    """
    rows, noise = None, config.noise_std_hint
    if noise is None:
        rows = store.tests_of(config.tag, LOOKED_AT)
        noise = _noise(store, rows)
    if request.model is not None:
        return LoopModel(request.model.plant(), "the model entered", None, noise)
    known = knowledge.of(config.tag, gains)
    if known is not None:
        covariance = known.model.covariance
        rows_of = None if covariance is None else tuple(tuple(row) for row in covariance)
        return LoopModel(known.model.process_model(), f"the model known from {known.source_text}", rows_of, noise)
    for row in store.tests_of(config.tag, LOOKED_AT) if rows is None else rows:
        if row.ended_at is None or row.reason in DISPROVED:
            continue
        found = found_model(row, store.events(row.id))
        if found is not None:
            return LoopModel(found, f"the model that job {row.id} found", None, noise)
        if row.reason is Reason.PV_LIMIT and (read_off := _of_record(store, row)) is not None:
            words = f"the record of job {row.id}, which ended as PV left its limits"
            return LoopModel(read_off, words, None, noise, rough=True)
    return None


def _noise(store: Store, rows: Sequence[Job]) -> float | None:
    """The noise of PV that the latest of these tests has seen at rest, PV units; None where none came so far."""
    for row in rows:
        for done in (event.stage_ended() for event in store.events(row.id)):
            if done is not None and done.stage == PREFLIGHT and done.result is not None:
                noise = done.result.get("noise")
                return float(noise) if isinstance(noise, int | float) else None
    return None


def _of_record(store: Store, row: Job) -> Model | None:
    """The model that the samples of a job tell; None where they tell none."""
    blocks = store.samples(row.id)
    first = next((k for k, (stage, _) in enumerate(blocks) if stage in MOVING), None)
    if first is None or row.found is None:
        return None
    rest = [each for _, samples in blocks[:first] for each in samples][-RESTED:]
    moved = [each for stage, samples in blocks[first:] for each in samples if stage in MOVING]
    return model_of_samples(rest, moved, loop_state(row.found).reverse_acting)


def model_of_samples(rest: Sequence[Sample], moved: Sequence[Sample], reverse: bool) -> Model | None:
    """The dead time and the slope that explain samples best; None where there are none of the right sign. So short a
    record tells no more, and a plant with a lag goes no further.

    rest, moved: the samples before MV or the set-point was moved, and since. reverse: the controller's action.
    """
    if min(len(rest), len(moved)) < MIN_SAMPLES:
        return None
    t, mv, pv = (np.array([each[k] for each in (*rest, *moved)]) for k in (0, 3, 2))
    at_rest = np.arange(len(t)) < len(rest)
    u = np.where(at_rest, 0.0, mv - float(np.mean(mv[at_rest])))
    y = pv - float(np.mean(pv[at_rest]))
    action, Ts, noise = 1.0 if reverse else -1.0, float(np.median(np.diff(t))), float(np.std(y[at_rest]))
    hidden = np.flatnonzero(np.abs(y) <= SHOWS * noise)
    since = int(hidden[-1]) if len(hidden) else 0
    # what MV does within a dead time of the end does not show yet
    acting = u[len(rest) : len(y) - max(0, since - len(rest))]
    if len(acting) and np.ptp(acting) == 0.0:
        return _from_one_step(float(acting[0]), y, Ts, len(moved), action, since)
    try:
        found = candidate_models(u, y, Ts, action, (INTEGRATOR,))
    except Refused:
        return None
    return found[0] if found else None


def _from_one_step(step: float, y: Reals, Ts: float, samples: int, action: float, since: int) -> Model | None:
    """The dead time and the slope of PV since it shows, where MV has made one step: a fit to the few samples of a fast
    rise takes the rise for noise.

    step: of MV, MV units. y: PV, as a deviation from rest, PV units. samples: those since the step.
    since: the last sample at which PV is no more than noise away.
    """
    rising = len(y) - 1 - since
    if step == 0.0 or rising == 0 or (y[-1] - y[since]) * step * action <= 0.0:
        return None
    slope = float(y[-1] - y[since]) / (rising * Ts)
    return Integrating(slope / step, max(0.0, (samples - 1) * Ts - float(y[-1]) / slope))
