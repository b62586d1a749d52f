"""The live state of a running job: its progress, its reports, and whether it is asked to stop."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping

from loopwright.service.jobs.journal import Journal
from loopwright.service.jobs.progress import Progress
from loopwright.service.jsonable import to_json_object
from loopwright.service.loops.observed_loop import ObservedLoop
from loopwright.service.store.journal_writes import block_of, event_of
from loopwright.service.telemetry.metrics import STAGE_SECONDS
from loopwright.tuning.plan import Event, Note, Sample, StageDone, StageStarted
from loopwright.tuning.reasons import Reason

_BLOCK_SAMPLES = 4096
_BLOCK_WALL_S = 1.0
_PACE_WALL_S = 2.0
"""Wall time after which the pace of a loop is known, s."""


class Running:
    """Holds the live state of one job. The thread of the job updates it; other threads read `progress_now` and may set
    `stop_reason`.

    before_s: plant time of the earlier attempts, s; the time of this attempt is added to it.
    retune: id of the batch that has begun the job; None: there is none.
    """

    def __init__(
        self,
        job_id: str,
        tag: str,
        journal: Journal,
        before_s: float = 0.0,
        monotonic: Callable[[], float] = time.monotonic,
        retune: str | None = None,
    ) -> None:
        self.job_id = job_id
        self.tag = tag
        self.retune = retune
        self.progress = Progress(before_s)
        self.loop: ObservedLoop | None = None
        self.stop_reason: Reason | None = None
        self.over = threading.Event()
        """Set when the loop is released and the end is written."""
        self.before_s = before_s
        self.pv_range: tuple[float, float] | None = None
        self.mv_range: tuple[float, float] | None = None
        """Ranges of the samples of this attempt."""
        self._journal = journal
        self._buffer: list[Sample] = []
        self._stage = "preflight"
        self._boundaries: list[tuple[float, str]] = []
        self._last_t = -math.inf
        self._first: tuple[float, float] | None = None
        """Plant time and wall time of the first sample, s."""
        self._monotonic = monotonic
        self._flushed = monotonic()

    def on_event(self, event: Event) -> None:
        """Takes an event of the procedure, which updates the progress and is stored."""
        self._keep_time()
        if isinstance(event, StageStarted):
            self.progress.stage_started(event)
            self._boundaries.append((self._last_t, event.stage))
            data: dict[str, object] = {
                "stage": event.stage, "expected_s": event.expected_s, "remaining_s": event.remaining_s,
            }  # fmt: skip
            self.tell("stage_started", data, stage=event.stage)
        elif isinstance(event, StageDone):
            self.flush()  # a finished stage never runs again, so its samples are stored first
            if self.loop is not None:  # a rehearsal takes no time of a real plant
                STAGE_SECONDS.labels(event.stage).observe(self.progress.stage_time_s)
            took = {"stage_time_s": self.progress.stage_time_s}
            self.tell("stage_done", {"stage": event.stage, "result": to_json_object(event.result), **took})
        elif isinstance(event, Note):
            self.tell("note", {"stage": self.progress.stage, "text": event.text})

    def on_samples(self, samples: list[Sample]) -> None:
        """Splits samples at the times of the stages: the runner's blocks do not end where a stage does."""
        self._keep_time()
        self.pv_range = _wider(self.pv_range, (sample.pv for sample in samples))
        self.mv_range = _wider(self.mv_range, (sample.mv for sample in samples))
        for sample in samples:
            while self._boundaries and sample.t > self._boundaries[0][0]:
                self.flush()
                self._stage = self._boundaries.pop(0)[1]
            self._buffer.append(sample._replace(t=sample.t + self.before_s) if self.before_s else sample)
        if len(self._buffer) >= _BLOCK_SAMPLES or self._monotonic() - self._flushed > _BLOCK_WALL_S:
            self.flush()

    def flush(self) -> None:
        """Passes the gathered samples on as one block of their stage."""
        if self._buffer:
            self._journal.put(block_of(self.job_id, self._stage, self._buffer))
            self._buffer = []
        self._flushed = self._monotonic()

    def progress_now(self) -> Progress:
        """Returns the progress at the latest sample, without changing any state."""
        return self.progress.seen_at(self.loop.t_s if self.loop else None)

    def pace(self) -> float | None:
        """Returns how many seconds of plant time a second of wall time had in this attempt: 1 on a real plant. None
        where it is not known yet, and of a rehearsal."""
        t = self.loop.t_s if self.loop else None
        if t is None or self._first is None:
            return None
        first_t, first_wall = self._first
        wall = self._monotonic() - first_wall
        return (t - first_t) / wall if wall >= _PACE_WALL_S and t > first_t else None

    def _keep_time(self) -> None:
        """Advances the progress to the latest sample."""
        t = self.loop.t_s if self.loop else None
        if t is not None:
            self._last_t = t
            self._first = self._first or (t, self._monotonic())
            self.progress.at(t)

    def tell(self, kind: str, data: Mapping[str, object], stage: str | None = None) -> None:
        """Stores an event of the job, and its stage where it is given, through the journal."""
        self._journal.put(event_of(self.job_id, kind, data, self.progress.plant_time_s, stage))


def _wider(found: tuple[float, float] | None, values: Iterable[float]) -> tuple[float, float] | None:
    """Returns the range that has these values too."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return found
    low, high = min(known), max(known)
    return (low, high) if found is None else (min(found[0], low), max(found[1], high))
