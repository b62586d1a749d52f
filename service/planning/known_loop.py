"""Collects what is known of a loop before a dry run, from its controller and from its earlier jobs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from loopwright.service.planning.found_model import DISPROVED, found_model
from loopwright.service.planning.ground import Ground, LastModel
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import LoopState, gains_of, loop_state
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.tuning.reasons import Ended

LOOKED_AT = 50
"""Number of the latest jobs that are searched for a model and for the controller's last state."""


def known(store: Store, tag: str, read: Callable[[], LoopState]) -> Ground:
    """Returns what is known of the loop.

    read: reads the present state of the loop; its Ended or OSError becomes `Ground.silence`.
    """
    rows = store.tests_of(tag, LOOKED_AT)
    last = _last_model(store, rows)
    try:
        return Ground(last, read(), silence="")
    except (Ended, OSError) as silent:
        words = f"{silent.reason.value}: {silent.detail}" if isinstance(silent, Ended) else str(silent)
    row = next((row for row in rows if row.found), None)
    if row is None or row.found is None:
        return Ground(last, silence=words)
    accepted = row.result.new_gains if row.state is JobState.ACCEPTED and row.result is not None else None
    gains = gains_of(row.previous_gains or row.found["gains"]) if accepted is None else accepted.gains()
    return Ground(last, replace(loop_state(row.found), gains=gains), row.id, words)


def _last_model(store: Store, rows: Sequence[Job]) -> LastModel | None:
    for row in rows:
        if row.ended_at is None or row.reason in DISPROVED:
            continue
        model = found_model(row, store.events(row.id))
        if model is not None:
            return LastModel(model, row.id, row.ended_at)
    return None
