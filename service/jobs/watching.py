"""Watches loops after gains were accepted: compares operation with the model, and puts the previous gains back by
itself where something goes wrong and that was asked for.

Nothing is moved for it, and nothing delays a job: the history is what the listener has heard, comparisons are made in
other processes with the lowest priority. What speaks against putting gains back, or leaves it in doubt, keeps the
watch from it: an alarm then says why.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial

import numpy as np

from loopwright.protocol.profile import Mode
from loopwright.service.errors import Conflict, Locked
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jobs.decisions import Decisions, new_gains
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.repeated import Repeated
from loopwright.service.listening.bins import UNKNOWN_MODE
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.listening.listening import Listening
from loopwright.service.observing.accepted_operation import accepted_model, compared, false_pv, oscillation
from loopwright.service.observing.hearing import question
from loopwright.service.observing.observed import Question
from loopwright.service.observing.resolution import wall_period_s
from loopwright.service.states.acceptance_watch import (
    CHANGES,
    MAX_CHANGES,
    PERIODS,
    AcceptanceWatch,
    Trouble,
    TroubleKind,
    WatchEnd,
)
from loopwright.service.states.job_state import IllegalMove, JobState
from loopwright.service.states.loop_state import LoopState, loop_state, same_gains
from loopwright.service.store import watches
from loopwright.service.store.clock import now, stamp
from loopwright.service.store.clock_watch import ClockWatch, longest_stop, uptime_s
from loopwright.service.store.hosts import Ages
from loopwright.service.store.jobs import Job
from loopwright.service.store.live_jobs import latest_jobs
from loopwright.service.store.store import Busy, Store
from loopwright.service.telemetry.logs import about
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.operation.model_conclusion import ModelState
from loopwright.tuning.reasons import Ended

log = logging.getLogger(__name__)

BY = "monitoring after acceptance"
"""Who puts gains back, as the audit log has it."""
OUTSIDE_S = 3.0
"""Wall time for which PV must be outside its limits, s."""
LONGEST_DAYS = 30.0
"""Wall time after which a watch ends that has not seen enough changes."""
_ROUND_S = 1.0
_LEAST_S = 2.0
"""Least wall time between two looks at the history of a loop, s; a quarter of the ultimate period where that is
longer."""
_EACH_S = 0.1
"""The same for each of the loops that are watched at a time, s: the thread shares its processor with the buses."""


@dataclass
class _LoopSeen:
    """A watched loop as this process knows it. Times are those of a clock that nobody sets, s.

    began_s: when this process saw the watch first. due_s: when the history of the loop is looked at again.
    inside: whether PV was within its limits since the acceptance.
    outside_from_s: since when PV is outside of them; None: it is not.
    mode, sp: the last that were heard. After a lost frame they are unknown until they are read, and where many are lost
    nearly always; the controller is read in any case before gains are put back.
    """

    began_s: float
    due_s: float = 0.0
    mode: int = UNKNOWN_MODE
    sp: float = math.nan
    inside: bool = False
    outside_from_s: float | None = None


class Watching:
    """Watches the loops of this host whose gains were accepted, in a thread.

    wall: the wall clock, s since 1970 UTC, and so the clock of the history.
    passed_s: the time that has passed, s, which nobody sets: what the watch itself waits for goes by this.
    Raises SQLAlchemyError.
    """

    def __init__(
        self,
        store: Store,
        directory: LoopDirectory,
        decisions: Decisions,
        listening: Listening,
        pool: Pool,
        wall: Callable[[], float] = time.time,
        passed_s: Callable[[], float] = uptime_s,
    ) -> None:
        self._store, self._directory, self._decisions = store, directory, decisions
        self._listening, self._pool, self._wall, self._passed_s = listening, pool, wall, passed_s
        self._ages = Ages(store, longest_stop(LONGEST_DAYS), ClockWatch(lambda: _utc(wall()), passed_s))
        self._loops: dict[str, _LoopSeen] = {}
        failed = "the loops with accepted gains could not be watched"
        self._looks = Repeated(self.look, _ROUND_S, "watches accepted gains", failed)
        self._compares = Repeated(self.compare, _ROUND_S, "compares operation with models", failed, at_once=False)
        self._to_compare: dict[str, Question] = {}

    def start(self) -> None:
        self._looks.start()
        self._compares.start()

    def close(self) -> None:
        self._looks.close()
        self._compares.close()

    def look(self) -> None:
        """Looks at every watched loop once. Raises SQLAlchemyError, FolderInUse."""
        open_ = watches.open_here(self._store)
        for job_id in self._loops.keys() - open_.keys():
            del self._loops[job_id]
        for job_id, (tag, watch) in open_.items():
            if self._looks.closed:
                return
            if (config := self._directory.loops.get(tag)) is not None:
                with about(job=job_id, loop=tag):
                    self._look(job_id, config, watch)

    def _look(self, job_id: str, config: LoopConfig, watch: AcceptanceWatch) -> None:
        job, now_s, passed_s = self._store.get(job_id), self._wall(), self._passed_s()
        if (
            watch.trouble is not None and watch.trouble.rolled_back is None
        ):  # this thread settles it before it looks again
            self._not_put_back(job_id, "the service ended, or could not write it down, meanwhile: read the loop")
        known = self._loops.setdefault(job_id, _LoopSeen(began_s=passed_s, inside=watch.inside))
        why = self._over(job, watch, known, now_s)
        if why is not None:
            self._end(job_id, why)
            return
        if now_s < max(watch.since_s, watch.looked_to_s):
            log.warning("the wall clock was set back: operation under the gains of job %s counts from now on", job_id)
            watch = watches.change(self._store, job_id, partial(watches.set_back, now_s=now_s)) or watch
            known.due_s = max(known.due_s, passed_s + _LEAST_S)  # the listener drops what it has heard before meanwhile
        heard = self._listening.heard.get(config.tag)
        no_data = self._listening.why_not_heard(config.tag)
        if no_data is None and (heard is None or heard.silent):
            no_data = "no data of the loop"
        if no_data != watch.no_data:
            watches.change(self._store, job_id, lambda now: now.model_copy(update={"no_data": no_data}))
        if no_data is not None or heard is None:
            known.outside_from_s = None
            return
        if known.mode == Mode.AUTOMATIC and heard.mode not in (UNKNOWN_MODE, Mode.AUTOMATIC):
            watch = self._disarmed(job_id, watch, heard.at_s)  # also where the history of it is lost
        text = self._outside(known, config, heard, passed_s)
        if known.inside and not watch.inside:  # a service that is started again need not see that for itself
            watch = watches.change(self._store, job_id, partial(_with, inside=True)) or watch
        if text is not None:
            self._trouble(job, config, watch, TroubleKind.PV_OUTSIDE_LIMITS, text)
        elif passed_s >= known.due_s:
            self._look_back(job, config, watch, known, now_s)

    def _over(self, job: Job, watch: AcceptanceWatch, known: _LoopSeen, now_s: float) -> WatchEnd | None:
        """Why a watch is over; None: it goes on."""
        if job.state is not JobState.ACCEPTED:
            return WatchEnd.ROLLED_BACK
        latest = latest_jobs(self._store, job.loop).get(job.loop)
        if latest is not None and latest.id not in (job.id, watch.latest_job):
            return WatchEnd.RETUNED
        read = self._listening.gains_read_since(job.loop, known.began_s)
        if read is not None and not same_gains(read, new_gains(job)):
            return WatchEnd.GAINS_CHANGED
        old = self._ages.before(_utc(now_s), timedelta(days=LONGEST_DAYS))
        return WatchEnd.TOO_LONG if old is not None and watch.since_s < old.timestamp() else None

    @staticmethod
    def _outside(known: _LoopSeen, config: LoopConfig, heard: Heard, passed_s: float) -> str | None:
        """In words that PV has left its limits; None: it has not, or the set-point has."""
        limits = config.pv_limits
        if heard.mode != UNKNOWN_MODE:
            known.mode = heard.mode
        if not math.isnan(heard.sp):
            known.sp = heard.sp
        low, high = heard.pv < limits.low, heard.pv > limits.high
        if known.mode != Mode.AUTOMATIC or not limits.low <= known.sp <= limits.high or not (low or high):
            known.inside = known.inside or (limits.low <= heard.pv <= limits.high)
            known.outside_from_s = None
            return None
        if not known.inside:
            return None
        if known.outside_from_s is None:
            known.outside_from_s = passed_s
        if passed_s - known.outside_from_s < OUTSIDE_S:
            return None
        side, limit = ("below", limits.low) if low else ("above", limits.high)
        return f"PV went {side} its limit of {limit:g} {config.pv_unit} under the new gains"

    def _look_back(self, job: Job, config: LoopConfig, watch: AcceptanceWatch, known: _LoopSeen, now_s: float) -> None:
        """Looks at the history since the acceptance. Raises SQLAlchemyError, FolderInUse."""
        asked = self._question(job, config, watch)
        bins = asked.rows.bins
        sample_time_s = asked.state.sample_time_s
        speed = (wall_period_s(bins) or sample_time_s) / sample_time_s  # a simulated plant may run faster
        least_s = max(_LEAST_S, _EACH_S * len(self._loops))
        known.due_s = self._passed_s() + max(least_s, 0.25 * watch.period_s * speed)
        left_s = _left_automatic(asked, watch.since_s)
        if left_s is not None:
            watch = self._disarmed(job.id, watch, left_s)
        false = false_pv(asked, watch.period_s, watch.since_s)
        if false is not None and false.sure:
            self._false_pv(job, watch, false.text)
            return
        found = oscillation(asked, new_gains(job), watch.period_s, watch.since_s)
        if found is not None and watch.trouble is None:
            text = (
                f"PV oscillates under the new gains with a period of {found.period_s:.3g} s, each "
                f"{found.per_period:.2f} times as large as the one before, {found.peak_to_peak:.3g} {config.pv_unit} "
                "from peak to peak at last"
            )
            self._trouble(job, config, watch, TroubleKind.GROWING_OSCILLATION, text)
            return
        self._to_compare[job.id] = asked
        if _complete(watch, (now_s - watch.since_s) / speed):
            self._end(job.id, WatchEnd.COMPLETE)

    def _disarmed(self, job_id: str, watch: AcceptanceWatch, left_s: float) -> AcceptanceWatch:
        """The watch of a loop that has left automatic at this wall time, s. Raises SQLAlchemyError, FolderInUse."""
        if watch.auto_rollback_off is not None or not watch.auto_rollback:
            return watch
        text = f"the mode was changed at {stamp(_utc(left_s))}"
        return watches.change(self._store, job_id, partial(_with, auto_rollback_off=text)) or watch

    def _question(self, job: Job, config: LoopConfig, watch: AcceptanceWatch) -> Question:
        state = _state(job)
        disturbers = self._directory.disturbers(config.tag)
        heard_by, spec = self._listening, DesignSpec()
        return question(heard_by, self._store, config, state, spec, disturbers, self._wall, watch.since_s)

    # what is compared

    def compare(self) -> None:
        """Compares what is new with the models. Raises SQLAlchemyError, FolderInUse."""
        while self._to_compare and not self._compares.closed:
            job_id, asked = self._to_compare.popitem()
            job = self._store.get(job_id)
            watch = watches.of_jobs(self._store, [job_id])[job_id]
            model = None if job.result is None else accepted_model(job.result, asked.state.sample_time_s)
            if model is None or watch.end is not None:
                continue
            from_s = max(watch.looked_to_s, watch.since_s)
            work = partial(compared, asked, model, from_s)
            try:
                found = self._pool.run(ComputationKind.LOOK, work, unwanted=lambda: self._compares.closed)
            except NotWanted:
                return
            except Ended as ended:
                log.warning("a change could not be compared with the model of job %s: %s", job_id, ended.detail)
                continue
            if found.changes and found.looked_to_s <= self._wall():  # else they are of a clock that was set back since
                changes = (*watch.changes, *found.changes)
                make = partial(_with, changes=changes, looked_to_s=found.looked_to_s)
                later = watches.change(self._store, job_id, make)
                log.info("watched %s: %s", job.loop, later.message if later else "the watch has ended")

    # what goes wrong

    def _false_pv(self, job: Job, watch: AcceptanceWatch, text: str) -> None:
        """Notes that PV is false. Nothing is written: what such a PV shows is no reason for anything."""
        if watch.trouble is not None:
            return
        why_not = "what a false PV shows is no reason to change gains"
        trouble = Trouble(kind=TroubleKind.FALSE_PV, at=now(), text=text, rolled_back=False, reason=why_not)
        if watches.change(self._store, job.id, partial(_with, trouble=trouble)) is not None:
            log.warning("%s: %s", job.loop, text)

    def _trouble(self, job: Job, config: LoopConfig, watch: AcceptanceWatch, kind: TroubleKind, text: str) -> None:
        """Notes what went wrong, and puts the previous gains back where that was asked for, unless PV is false."""
        if watch.trouble is not None:
            return
        false = false_pv(self._question(job, config, watch), watch.period_s, watch.since_s)
        if false is not None:
            if false.sure:
                self._false_pv(job, watch, false.text)
            return  # else it is looked at again
        trouble = Trouble(kind=kind, at=now(), text=text)
        noted = watches.change(self._store, job.id, partial(_with, trouble=trouble))
        if noted is None:
            return
        log.warning("%s: %s", job.loop, text)
        if not watch.armed:
            self._not_put_back(
                job.id, watch.auto_rollback_off or "that was not asked for as the new ones were accepted"
            )
            return
        try:
            self._decisions.roll_back_accepted(job.id, BY)
        except (Ended, Conflict, Locked, Busy, IllegalMove) as error:
            why = error.detail if isinstance(error, Ended) else str(error)
            log.error("the previous gains of %s could not be put back: %s", job.loop, why)
            self._not_put_back(job.id, why)

    def _not_put_back(self, job_id: str, why: str) -> None:
        watches.settle(self._store, job_id, partial(watches.settled, rolled_back=False, reason=why))

    def _end(self, job_id: str, why: WatchEnd) -> None:
        log.info("the watch of job %s has ended: %s", job_id, why)
        watches.change(self._store, job_id, lambda watch: watches.ended(watch, why))


def _utc(at_s: float) -> datetime:
    return datetime.fromtimestamp(at_s, UTC)


def _with(watch: AcceptanceWatch, **fields: object) -> AcceptanceWatch:
    return watch.model_copy(update=fields)


def _state(job: Job) -> LoopState:
    """The loop as it was accepted; its gains are the new ones."""
    data = job.restored or job.found
    if data is None:
        raise Conflict(f"job {job.id} has not read its loop")
    return replace(loop_state(data), gains=new_gains(job))


def _complete(watch: AcceptanceWatch, passed_s: float) -> bool:
    """passed_s: plant time since the acceptance, s."""
    decided = watch.informative >= CHANGES and watch.conclusion().state is not ModelState.OPEN
    enough = decided or len(watch.changes) >= MAX_CHANGES
    return enough and passed_s >= PERIODS * watch.period_s


def _left_automatic(asked: Question, since_s: float) -> float | None:
    """When a loop that was in automatic since then has left it, wall time, s; None: it has not."""
    bins = asked.rows.bins
    known = bins[(bins["at_s"] > since_s) & (bins["mode"] >= 0)]
    automatic = known["mode"] == Mode.AUTOMATIC
    if not automatic.any():
        return None
    later = known[int(np.argmax(automatic)) :]
    left = later[later["mode"] != Mode.AUTOMATIC]
    return float(left["at_s"][0]) if len(left) else None
