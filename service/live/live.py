"""The live stream: one producer for all viewers of this service, which works only while somebody looks.

Samples and rows come from the process that listens, and need no database. The jobs are looked up a few times a second,
whatever the number of viewers; while the database is away, what was known of them last stays.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from importlib.metadata import version

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.alarms.alarm import AlarmList
from loopwright.service.alarms.watch import LOOK_S as ALARM_LOOK_S
from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.jobs.journal import temporary
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.bins import of_samples
from loopwright.service.listening.listening import Listening
from loopwright.service.listening.messages import NewSamples
from loopwright.service.listening.process import ANSWER_S
from loopwright.service.live.jobs import LookedUpJobs
from loopwright.service.live.messages import RETRY_MS, Buses, Hello, Loops, event
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.own_gateway import OwnGateway
from loopwright.service.live.rows import LiveFacts, loop_row, samples_message, with_jobs
from loopwright.service.live.viewer import Viewer
from loopwright.service.store.keyring import REVOKED_WITHIN_S

log = logging.getLogger(__name__)

MOST_BACK_S = 600.0
_PAST_POINTS = 3000
"""Samples from before the stream at most, by loop: older ones are thinned."""
LOOK_S = 0.25
"""Wall time between two looks at the jobs, s."""
ALARMS_S = 2.0 * ALARM_LOOK_S
"""Age of the last look at the alarms up to which none is made here, s: they are looked at without viewers too."""
_THOROUGHLY = 4
"""Every so many looks the latest jobs and the loops of other hosts are asked for too."""
_BEAT_S = 1.2
"""Wall time after which the rows are sent although nothing new was heard, s."""
_PATIENCE_S = 0.5
_FIRST_LOOK_S = 1.0


class Live:
    """The methods belong to one event loop, that of the server. listening: calls back in threads of its own.
    alarms: so does it; None for one that looks only when it is asked.  others: None for what the database says."""

    def __init__(
        self,
        jobs: Jobs,
        listening: Listening,
        alarms: AlarmWatch | None = None,
        others: OtherGateways | None = None,
    ) -> None:
        self._jobs, self._listening = jobs, listening
        self._own, self._others = OwnGateway(jobs, listening), others or OtherGateways(jobs.store)
        self._alarms = alarms or AlarmWatch(jobs, listening, self._others)
        self._looked_up = LookedUpJobs(jobs, self._others)
        self._viewers: set[Viewer] = set()
        self._working: tuple[asyncio.Task[None], ...] = ()
        self._reported = asyncio.Event()
        self._looked = asyncio.Event()
        self._shown: dict[str, str] = {}
        self._over = False

    @property
    def viewers(self) -> int:
        """Returns how many viewers there are."""
        return len(self._viewers)

    def close(self) -> None:
        """Ends every stream; those that begin later end at once."""
        self._over = True
        for viewer in self._viewers:
            viewer.wake()

    async def stream(
        self,
        tags: tuple[str, ...],
        back_s: float,
        after: dict[str, int],
        permitted: Callable[[], bool] = lambda: True,
    ) -> AsyncIterator[str]:
        """The messages for one viewer as text/event-stream, until it goes, or `permitted` returns false, or the
        service stops.

        tags: loops whose samples and events are wanted.
        back_s: how far the first samples go back, s.
        after: number of the last event that the viewer has, by job.
        """
        viewer = Viewer(frozenset(tags), after)
        self._enter(viewer)
        asked, checking = time.monotonic(), None
        try:
            yield f"retry: {RETRY_MS}\n" + event(
                "hello",
                Hello(
                    gateway=self._jobs.store.host, version=version("loopwright"), now_s=round(time.time(), 3),
                    loops=list(tags), back_s=back_s,
                ),
            )  # fmt: skip
            with suppress(TimeoutError):
                async with asyncio.timeout(_FIRST_LOOK_S):
                    await self._looked.wait()
            if "loops" not in self._shown:
                self._show_rows()
            for name, text in self._shown.items():
                viewer.show(name, text)
            for tag in tags:
                yield await self._past(viewer, tag, back_s)
            while not self._over:
                if viewer.slow:
                    yield ": this viewer takes too little of the stream, begin again\n\n"
                    return
                for text in (*viewer.take(), *self._looked_up.events_for(viewer)):
                    yield text
                if checking is None and time.monotonic() - asked > REVOKED_WITHIN_S:
                    checking = asyncio.create_task(asyncio.to_thread(permitted))
                if checking is not None and checking.done():
                    if not _permitted(checking):
                        yield ": the key of this stream was revoked or has expired\n\n"
                        return
                    asked, checking = time.monotonic(), None
                await viewer.woken(_PATIENCE_S)
        finally:
            self._leave(viewer)

    async def _past(self, viewer: Viewer, tag: str, back_s: float) -> str:
        now_s = time.time()
        # What is heard until the answer belongs to it: samples are sent as they come only from some moment after now.
        until_s = now_s + ANSWER_S
        rows = await asyncio.to_thread(self._listening.memory, tag, now_s - back_s, until_s, _PAST_POINTS)
        if len(rows.bins):
            viewer.has_until(tag, rows.bins["until_s"][-1].item())
        return event("samples", samples_message(tag, rows.bins, past=True))

    # -- the producer

    def _enter(self, viewer: Viewer) -> None:
        self._viewers.add(viewer)
        if not self._working:
            self._reported, self._looked = asyncio.Event(), asyncio.Event()
            self._shown.clear()
            here = asyncio.get_running_loop()
            self._listening.on_report = lambda: _soon(here, self._reported.set)
            self._listening.on_samples = lambda new: _soon(here, self._share, new)
            self._alarms.on_change = lambda: _soon(here, self._show_alarms)
            self._working = tuple(asyncio.create_task(work()) for work in (self._keep_rows, self._keep_jobs))
        self._watch()

    def _leave(self, viewer: Viewer) -> None:
        self._viewers.discard(viewer)
        self._watch()
        if not self._viewers:
            for task in self._working:
                task.cancel()
            self._working = ()

    def _watch(self) -> None:
        self._listening.watch(frozenset[str]().union(*(viewer.tags for viewer in self._viewers)))

    def _share(self, new: NewSamples) -> None:
        for tag, samples in new.samples.items():
            theirs = [viewer for viewer in self._viewers if tag in viewer.tags]
            if theirs:
                bins = of_samples(samples)
                text = event("samples", samples_message(tag, bins, past=False))
                for viewer in theirs:
                    viewer.add_samples(tag, bins, text)

    async def _keep_rows(self) -> None:
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(_BEAT_S):
                    await self._reported.wait()
            self._reported.clear()
            try:
                self._show_rows()
                self._show("jobs", event("jobs", self._looked_up.message()))
            except Exception:  # the next rows are shown all the same
                log.exception("defect while showing the present state of the loops")

    async def _keep_jobs(self) -> None:
        looks = 0
        while True:
            watched = frozenset[str]().union(*(viewer.tags for viewer in self._viewers))
            before = {(job.id, job.state, job.stage, job.stopping) for job in self._looked_up.live}
            try:
                await asyncio.to_thread(self._looked_up.look, watched, looks % _THOROUGHLY == 0)
            except SQLAlchemyError as error:
                if not temporary(error):
                    log.exception("the live jobs could not be looked up")
            except Exception:  # the streams go on with what was known last
                log.exception("defect while looking up the live jobs")
            try:
                await asyncio.to_thread(self._alarms.look, ALARMS_S)
            except Exception:
                log.exception("defect while looking for what is abnormal")
            looks += 1
            if before != {(job.id, job.state, job.stage, job.stopping) for job in self._looked_up.live} or looks == 1:
                self._show("jobs", event("jobs", self._looked_up.message()))
            self._show_alarms()
            self._looked.set()
            for viewer in self._viewers:
                viewer.wake()
            await asyncio.sleep(LOOK_S)

    def _show_alarms(self) -> None:
        if self._alarms.latest is not None:
            self._show("alarms", event("alarms", AlarmList(alarms=list(self._alarms.latest))))

    def _show_rows(self) -> None:
        self._show_alarms()
        now_s = time.time()
        found, heard = self._looked_up, self._listening.heard
        job_of = {job.loop: job for job in found.live if not job.dry_run}
        rows = []
        for tag, host in found.loops:
            job = job_of.get(tag)
            last, locked = found.latest.get(tag), found.locked.get(tag)
            if host != self._jobs.store.host:
                rows.append(with_jobs(self._others.values(tag, host), host, job, last, locked))
                continue
            running = None if job is None else self._jobs.running(job.id)
            held = running.loop.latest if running is not None and running.loop is not None else None
            deaf = self._listening.why_not_heard(tag)
            rows.append(loop_row(tag, host, LiveFacts(heard.get(tag), deaf, held, job, last, locked), now_s))
        self._show("loops", event("loops", Loops(now_s=round(now_s, 3), loops=rows)))
        self._show("buses", event("buses", Buses(buses=[*self._own.buses(), *self._others.buses()])))

    def _show(self, name: str, text: str) -> None:
        """Shows a message to all viewers, unless it is as before."""
        if self._shown.get(name) != text:
            self._shown[name] = text
            for viewer in self._viewers:
                viewer.show(name, text)


def _permitted(checked: asyncio.Task[bool]) -> bool:
    """Whether the key is valid; it counts as valid while the database does not answer."""
    error = checked.exception()
    if error is None:
        return checked.result()
    if isinstance(error, SQLAlchemyError) and temporary(error):
        return True
    raise error


def _soon(here: asyncio.AbstractEventLoop, call: Callable[..., object], *arguments: object) -> None:
    with suppress(RuntimeError):  # the event loop is closed
        here.call_soon_threadsafe(call, *arguments)
