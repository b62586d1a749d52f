"""The question for a loop of the service: its history, at the right resolution, and the times of its tests and of those
of its neighbours."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from datetime import UTC, datetime

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.listening.listening import History, Listening
from loopwright.service.observing.observed import Question
from loopwright.service.observing.resolution import FIRST_S, resolution
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.job_knowledge import outdated_until_s
from loopwright.service.store.store import Store
from loopwright.service.store.under_test import TimeUnderTest, times_under_test
from loopwright.tuning.fast.design.design import DesignSpec

_ALL = 1_000_000
"""More rows than a history of these times can have."""


def question(
    listening: Listening,
    store: Store,
    config: LoopConfig,
    state: LoopState,
    spec: DesignSpec,
    disturbers: Collection[str] = (),
    clock: Callable[[], float] = time.time,
    accepted_s: float = math.inf,
) -> Question:
    """Everything that the evaluation needs. Raises SQLAlchemyError.

    disturbers: the loops whose tests disturb this one, see `neighbours`.
    accepted_s: wall time of an acceptance, before which every test of the loop has ended: what says to be of a later
    time is of a clock that was set back since, and does not count.
    """
    now_s = clock()

    def history(from_s: float) -> History:
        return listening.history(config.tag, from_s, now_s, _ALL)

    found, together = history(now_s - FIRST_S), 1
    wanted = resolution(found.rows.bins, config.t95_s / state.sample_time_s)
    if wanted is not None:
        together, found = wanted.together, history(wanted.from_s)
    from_s = float(found.rows.bins["at_s"][0]) if len(found.rows.bins) else now_s
    own = [each for each in _tests(store, (config.tag,), from_s) if each.to_s is None or each.to_s <= accepted_s]
    theirs = [each for each in _tests(store, disturbers, from_s) if each.session]
    times = [each.within(from_s, now_s) for each in (*own, *theirs)]
    until_s = outdated_until_s(store, config.tag)
    if until_s is not None and until_s <= accepted_s:  # what was heard before is of another plant
        times.append((from_s, until_s))
    return Question(
        config,
        state,
        spec,
        found.rows,
        together,
        [each for each in times if each is not None],
        found.no_data,
        tuple(sorted({each.loop for each in theirs})),
    )


def _tests(store: Store, loops: Collection[str], from_s: float) -> Sequence[TimeUnderTest]:
    return times_under_test(store, loops, datetime.fromtimestamp(from_s, UTC)) if loops else ()
