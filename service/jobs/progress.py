"""The progress of a job in plant time: the time so far compared with what the plan still expects."""

from __future__ import annotations

from copy import copy

from loopwright.tuning.plan import StageStarted


class Progress:
    """Takes stages and plant times; gives a fraction that never falls, and the remaining plant time in s.

    The properties change nothing: a reader uses a copy (`seen_at`) that is advanced to the latest sample.
    """

    def __init__(self, before_s: float = 0.0) -> None:
        """Begins the progress of an attempt.

        before_s: plant time that earlier attempts of the job took, s.
        """
        self.stage: str | None = None
        self._before_s = before_s
        self._reached = 0.0  # the fraction at the end of the previous stage
        self._start_s: float | None = None
        self._now_s = 0.0
        self._stage_start_s = 0.0
        self._expected_s = 0.0
        self._after_s = 0.0
        self._known = False

    def stage_started(self, event: StageStarted) -> None:
        """Begins a stage with its expected plant time."""
        self._reached = self.fraction
        self.stage = event.stage
        self._stage_start_s = self._now_s
        self._expected_s, self._after_s = event.expected_s, event.remaining_s
        self._known = True

    def at(self, t_s: float) -> None:
        """Sets the plant time of the latest sample, s."""
        if self._start_s is None:
            self._start_s = self._now_s = self._stage_start_s = t_s
        self._now_s = t_s

    def seen_at(self, t_s: float | None) -> Progress:
        """Returns a copy at that plant time, or a plain copy where the progress is later already or the time is
        None."""
        advanced = copy(self)
        if t_s is not None:
            advanced.at(max(t_s, self._now_s))
        return advanced

    @property
    def plant_time_s(self) -> float:
        """Returns the plant time since the job's first sample, s."""
        return self._before_s + self._now_s - (self._start_s or 0.0)

    @property
    def stage_time_s(self) -> float:
        """Returns the plant time since the present stage began, s."""
        return self._now_s - self._stage_start_s

    @property
    def remaining_s(self) -> float | None:
        """Returns the expected plant time to the end, s; None before the plan has given one."""
        if not self._known:
            return None
        # A stage that overruns its expected time is not "finished": a tenth of that time counts as remaining.
        in_stage = max(self._expected_s - (self._now_s - self._stage_start_s), 0.1 * self._expected_s)
        return in_stage + self._after_s

    @property
    def fraction(self) -> float:
        """Returns the fraction done, 0 to 1; it stays below 1 until the job has ended."""
        remaining = self.remaining_s
        if remaining is None:
            return self._reached
        total = self.plant_time_s + remaining
        return max(self._reached, min(0.99, self.plant_time_s / total if total > 0 else 0.0))
