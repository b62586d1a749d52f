"""How far a job is, in plant time: what is done against what the plan still expects."""

from __future__ import annotations

from copy import copy

from loopwright.tuning.plan import StageStarted


class Progress:
    """Fed with stages and with plant time; answers a fraction that never falls, and the remaining plant seconds.

    Answering changes nothing: whoever only reads asks a copy (`seen_at`) that is brought up to the latest sample.
    """

    def __init__(self, before_s: float = 0.0) -> None:
        """before_s: plant time that earlier attempts of the job took, s."""
        self.stage: str | None = None
        self._before_s = before_s
        self._reached = 0.0  # the fraction at the end of the stage before
        self._start_s: float | None = None
        self._now_s = 0.0
        self._stage_start_s = 0.0
        self._expected_s = 0.0
        self._after_s = 0.0
        self._known = False

    def stage_started(self, event: StageStarted) -> None:
        self._reached = self.fraction
        self.stage = event.stage
        self._stage_start_s = self._now_s
        self._expected_s, self._after_s = event.expected_s, event.remaining_s
        self._known = True

    def at(self, t_s: float) -> None:
        """The plant time of the latest sample, s."""
        if self._start_s is None:
            self._start_s = self._now_s = self._stage_start_s = t_s
        self._now_s = t_s

    def seen_at(self, t_s: float | None) -> Progress:
        """A copy at that plant time, or as it is where it is later already; None: as it is."""
        found = copy(self)
        if t_s is not None:
            found.at(max(t_s, self._now_s))
        return found

    @property
    def plant_time_s(self) -> float:
        """Plant time since the job's first sample, s."""
        return self._before_s + self._now_s - (self._start_s or 0.0)

    @property
    def stage_time_s(self) -> float:
        """Plant time since the present stage began, s."""
        return self._now_s - self._stage_start_s

    @property
    def remaining_s(self) -> float | None:
        """Expected plant time to the end, s; None before the plan has said anything."""
        if not self._known:
            return None
        # A stage that overruns its expectation is not "finished": a tenth of it is kept as remaining.
        in_stage = max(self._expected_s - (self._now_s - self._stage_start_s), 0.1 * self._expected_s)
        return in_stage + self._after_s

    @property
    def fraction(self) -> float:
        """0 to 1; stays below 1 until the job has ended."""
        remaining = self.remaining_s
        if remaining is None:
            return self._reached
        total = self.plant_time_s + remaining
        return max(self._reached, min(0.99, self.plant_time_s / total if total > 0 else 0.0))
