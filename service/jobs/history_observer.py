"""Looks at the history of the loops by itself, as operation goes on, so that what is known of them stays up to date.

A look is a computation of the lowest priority. There is never more than one, none while the loop is under test, and one
in LOOK_EVERY_S at most. Nothing is written to a loop: its state is read, as for every answer.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from loopwright.protocol.profile import Mode
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.registry import Registry
from loopwright.service.jobs.repeated import Repeated
from loopwright.service.listening.bins import Bins
from loopwright.service.listening.listening import Listening
from loopwright.service.listening.rings import SAMPLES
from loopwright.service.observing.hearing import question
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.observing.observed import observed
from loopwright.service.observing.resolution import FIRST_S, wall_period_s
from loopwright.service.store.store import Store
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.design.options import weights_up_to
from loopwright.tuning.models import Reals
from loopwright.tuning.reasons import Ended

log = logging.getLogger(__name__)

LOOK_EVERY_S = 600.0
"""Least wall time between two looks at a loop, s; half of the time for which its samples are in memory where that is
shorter."""
CHECK_S = 60.0
"""Wall time between two checks whether a set-point was changed, s; a quarter of that time where that is shorter."""
FOLLOWED_T95 = 6.5
"""Plant time after a set-point change before it is looked at, T95: five ultimate periods, at most 1.3 T95 each."""
POINTS = 2000
"""Bins in which set-point changes are looked for: shorter than the time between two changes of an operator."""
_ROUND_S = 5.0


@dataclass
class _Loop:
    """A loop as the looks know it. Times are wall time, s since 1970 UTC.

    due_s: when it is checked again. looked_at_s: when it was looked at last. heard_to_s: until when its set-point
    changes have been looked at, None: nothing yet. sample_time_s: that of its controller, None: not read yet.
    """

    due_s: float = 0.0
    looked_at_s: float = -math.inf
    heard_to_s: float | None = None
    sample_time_s: float | None = None


class HistoryObserver:
    """Looks at the loops of this host, in a thread.

    wall: the wall clock, s since 1970 UTC, and so the clock of the history.
    """

    def __init__(
        self,
        directory: LoopDirectory,
        registry: Registry,
        store: Store,
        listening: Listening,
        knowledge: KeptKnowledge,
        pool: Pool,
        every_s: float = LOOK_EVERY_S,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._directory, self._registry, self._store = directory, registry, store
        self._listening, self._knowledge, self._pool = listening, knowledge, pool
        self._every_s, self._wall = every_s, wall
        self._spec = DesignSpec()
        self._loops = {tag: _Loop() for tag in directory.loops}
        self._latest_s = -math.inf
        failed = "the histories of the loops could not be looked at"
        self._looks = Repeated(self.look_at_due_loops, _ROUND_S, "looks at histories", failed, at_once=False)

    def start(self) -> None:
        self._looks.start()

    def close(self) -> None:
        self._looks.close()

    def look_at_due_loops(self) -> list[str]:
        """Looks at every loop whose time has come and whose set-point was changed. Returns their tags. Raises
        SQLAlchemyError, FolderInUse."""
        began_s = self._wall()
        if began_s < self._latest_s:  # the clock was put back, and with it the history
            self._loops = {tag: _Loop() for tag in self._loops}
        self._latest_s = began_s
        looked: list[str] = []
        due = [
            config
            for config in self._directory.loops.values()
            if config.setpoint_from != "remote"
            and config.bus not in self._listening.off  # nothing new is heard of it
            and began_s >= self._loops[config.tag].due_s
        ]
        waiting = self._store.busy() if due else {}  # of all loops at once: a job that begins now is under test
        for config in due:
            if self._stopping():
                break
            known, now_s = self._loops[config.tag], self._wall()
            if config.tag in waiting or self._under_test(config.tag):
                continue
            known.due_s = now_s + CHECK_S
            try:
                if self._check(config, known, now_s):
                    looked.append(config.tag)
            except Ended as ended:
                log.info("the history of %s was not looked at: %s", config.tag, ended.detail)
        return looked

    def _check(self, config: LoopConfig, known: _Loop, now_s: float) -> bool:
        """Looks at a loop where that is due and a set-point change has been followed. Returns whether it has. Raises
        Ended."""
        from_s = now_s - FIRST_S if known.heard_to_s is None else known.heard_to_s
        bins = self._listening.history(config.tag, from_s, now_s, POINTS).rows.bins
        heard = bins[np.isfinite(bins["sp"])]
        if not len(heard):
            return False
        moved_s = moves(bins)
        if not len(moved_s):
            known.heard_to_s = float(heard["until_s"][-1])  # from here on, so that a change just after it is seen
            return False
        known.heard_to_s = from_s
        if known.sample_time_s is None:
            known.sample_time_s = self._directory.read(config.tag).sample_time_s
        period_s = wall_period_s(bins) or known.sample_time_s  # shorter on a simulated plant that runs fast
        in_memory_s = SAMPLES * period_s
        known.due_s = now_s + min(CHECK_S, 0.25 * in_memory_s)
        followed = moved_s[moved_s <= now_s - FOLLOWED_T95 * config.t95_s / known.sample_time_s * period_s]
        if not len(followed) or now_s < known.looked_at_s + min(self._every_s, 0.5 * in_memory_s):
            return False
        if not self._look(config):
            return False
        known.looked_at_s, known.heard_to_s = now_s, float(followed[-1])
        return True

    def _look(self, config: LoopConfig) -> bool:
        """Looks at one loop. Returns False where the set-point changes have to be looked at again. Raises Ended."""
        state, disturbers = self._directory.read(config.tag), self._directory.disturbers(config.tag)
        spec = replace(self._spec, weights=weights_up_to(config.setpoint_weight_max))
        asked = question(self._listening, self._store, config, state, spec, disturbers, self._wall)
        try:
            found = self._pool.run(
                ComputationKind.LOOK,
                partial(observed, asked),
                unwanted=lambda: self._stopping() or self._under_test(config.tag),
            )
        except NotWanted:
            return False
        log.info("looked at the history of %s: %s; %s", config.tag, found.known, found.detail)
        self._knowledge.observed(found, self._spec.Ms, state.sample_time_s)
        return True

    def _under_test(self, tag: str) -> bool:
        return tag in self._registry.under_test().values()

    def _stopping(self) -> bool:
        return self._looks.closed or self._registry.stopping


def moves(bins: Bins) -> Reals:
    """The ends of the bins in which the set-point of a loop in automatic is another one than in the bin before."""
    known = bins[(bins["mode"] == Mode.AUTOMATIC) & np.isfinite(bins["sp"])]
    return np.asarray(known["until_s"][1:][known["sp"][1:] != known["sp"][:-1]])
