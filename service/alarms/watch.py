"""Looks once a second at what is abnormal, and takes acknowledgements."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from loopwright.service.alarms.alarm import PRIORITIES, RULES, Acknowledgement, Alarm, AlarmKind, Priority
from loopwright.service.alarms.conditions import conditions
from loopwright.service.alarms.delays import Delays
from loopwright.service.alarms.facts import FactSource, GatewaysSeen
from loopwright.service.alarms.merging import merged, only_known_here
from loopwright.service.errors import Conflict
from loopwright.service.jobs.manager import Jobs
from loopwright.service.jobs.repeated import Repeated
from loopwright.service.listening.listening import Listening
from loopwright.service.store import alarms as stored
from loopwright.service.store.alarms import NOT_RESTORED, AlreadyAcknowledged
from loopwright.service.store.clock import now
from loopwright.service.store.false_pv import FALSE_PV
from loopwright.service.store.tables import AlarmAcknowledgementRow

LOOK_S = 1.0
"""Wall time between two looks, s."""
FRESH_S = 0.25
"""Age up to which a look is used again, s, so that frequent questions cost no more."""


class NoSuchAlarm(Exception):
    """No alarm of that id."""

    def __init__(self, alarm_id: str) -> None:
        super().__init__(
            f"there is no alarm {alarm_id}: it has gone by itself, or never was; GET /alarms has those there are"
        )


class AlarmWatch:
    """The alarms of this gateway, and those of the others of the database.

    others: what is known of these; None: their tests alone are.
    clock: the wall time, s.
    """

    def __init__(
        self,
        jobs: Jobs,
        listening: Listening,
        others: GatewaysSeen | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._store = jobs.store
        self._source = FactSource(jobs, listening, others)
        self._clock = clock
        self._delays = Delays()
        self._looking = threading.Lock()
        self._looked = 0.0
        self.latest: Sequence[Alarm] | None = None
        """The alarms as they were seen last, the worst first, replaced as a whole; None before the first look."""
        self.on_change: Callable[[], None] = lambda: None
        """Called in another thread when `latest` is another list than before."""
        failed = "what is abnormal could not be looked for"
        self._looks = Repeated(lambda: self.look(0.5 * LOOK_S), LOOK_S, "alarms", failed)

    def start(self) -> None:
        """Looks from now on by itself, in the background."""
        self._looks.start()

    def close(self) -> None:
        self._looks.close()

    def look(self, fresh_s: float = 0.0) -> Sequence[Alarm]:
        """Looks now, unless the last look is no older than this, s. Returns the alarms, the worst first."""
        with self._looking:
            before = self.latest
            if before is not None and time.monotonic() - self._looked < fresh_s:
                return before
            now_s = self._clock()
            known = self._source.gather(now_s)
            found = tuple(merged(self._delays.step(conditions(known), now_s), known))
            self.latest, self._looked = found, time.monotonic()
        if found != before:
            self.on_change()
        return found

    def counts(self) -> dict[Priority, int]:
        """Returns how many alarms of each priority this gateway has, as they were seen last; those of others are left
        out, so that the sum over all gateways has each once."""
        found = Counter(alarm.priority for alarm in self.latest or () if alarm.gateway == self._store.host)
        return {priority: found[priority] for priority in PRIORITIES}

    def only_known_here(self) -> list[Alarm]:
        """Returns the alarms, as they were seen last, of which the other gateways know only what this one says."""
        return only_known_here(self.latest or (), self._store.host)

    def find(self, alarm_id: str) -> Alarm:
        """Returns an alarm, also one that was acknowledged. Raises NoSuchAlarm, SQLAlchemyError."""
        alarm = _of(self.look(FRESH_S), alarm_id)
        if alarm is not None:
            return alarm
        row = stored.find(self._store, alarm_id)
        if row is None:
            raise NoSuchAlarm(alarm_id)
        return _acknowledged(row)

    def acknowledge(self, alarm_id: str, by: str) -> Alarm:
        """Acknowledges an alarm: a person answers for it, and it ends. Raises NoSuchAlarm, Conflict (it ends by itself,
        or was acknowledged already), SQLAlchemyError."""
        alarm = _of(self.look(), alarm_id)
        if alarm is None:
            row = stored.find(self._store, alarm_id)
            if row is None:
                raise NoSuchAlarm(alarm_id)
            raise Conflict(str(AlreadyAcknowledged(row)))
        if not alarm.unacknowledged:
            raise Conflict(
                f"an alarm of priority {alarm.priority} is not acknowledged: it goes by itself "
                f"{RULES[alarm.kind].off_s:g} s after its cause has gone. {alarm.subject}: {alarm.text}"
            )
        row = AlarmAcknowledgementRow(
            alarm_id=alarm.id, priority=alarm.priority, kind=alarm.kind.value, host=alarm.gateway, loop=alarm.loop,
            job_id=None if alarm.job is None else alarm.job.rpartition("/")[2],
            text=alarm.text, since=alarm.since, by=by, at=now(),
        )  # fmt: skip
        try:
            stored.acknowledge(self._store, row)
        except AlreadyAcknowledged as error:
            raise Conflict(str(error)) from error
        self.look()
        return _acknowledged(row)


def _of(alarms: Iterable[Alarm], alarm_id: str) -> Alarm | None:
    return next((alarm for alarm in alarms if alarm.id == alarm_id), None)


def _acknowledged(row: AlarmAcknowledgementRow) -> Alarm:
    loops = [] if row.loop is None else [row.loop]
    return Alarm(
        id=row.alarm_id, priority=_PRIORITIES[row.priority], kind=AlarmKind(row.kind), subject=row.loop or row.host,
        text=row.text, advice="Nothing is left to do: it was acknowledged.", since=row.since, gateway=row.host,
        loop=row.loop, loops=loops, job=None if row.job_id is None else f"/jobs/{row.job_id}", unacknowledged=False,
        acknowledged=Acknowledgement(by=row.by, at=row.at),
    )  # fmt: skip


_PRIORITIES: dict[int, Priority] = {priority: priority for priority in PRIORITIES}
assert (NOT_RESTORED, FALSE_PV) == (AlarmKind.NOT_RESTORED, AlarmKind.FALSE_PV)
