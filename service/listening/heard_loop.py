"""From the frames of one loop to its history. Pure: times are handed in.

Samples are put together as the tuner's client does it, and have the same values as those that a job stores; their
numbers tell what is missing. PDOs carry set-point and mode only when they change, and gains never: until the service
has read them, after every gap and when a session or a trial begins or ends, what is not known is kept as unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from loopwright.protocol.process_data import ProcessData
from loopwright.protocol.profile import Mode, samples_between
from loopwright.protocol.real32 import nearest, shortest
from loopwright.service.listening.bins import GAP_BEFORE, UNKNOWN_MODE, GainSet
from loopwright.service.listening.rings import Rings

SILENCE_S = 3.0
"""Time without a sample, and at least three sampling periods, after which what comes next comes after a gap, s."""
READ_AGAIN_S = 60.0
_MODES = frozenset(mode.value for mode in Mode)


@dataclass(frozen=True)
class InEffect:
    """What a reading of a loop, begun at this time, has found.

    gains: None where they cannot be known, because another tuner has gains on trial.
    sample_time_s: the sampling period that the controller reports (1006h), s of plant time.
    """

    began_s: float
    sp: float
    mode: int
    on_trial: bool
    gains: GainSet | None
    sample_time_s: float


@dataclass(frozen=True)
class Heard:
    """What was heard last of a loop. Numbers that are not known are NaN, the mode UNKNOWN_MODE, the rest None.

    at_s: time of the last sample, s.
    silent: whether further samples are due and do not come.
    session: whether a tuner has a session open on the controller.
    """

    at_s: float
    silent: bool
    pv: float
    mv: float
    sp: float
    mode: int
    on_trial: bool | None
    session: bool | None


class HeardLoop:
    """Takes the frames of one loop. The methods that take a frame raise struct.error for a foreign one."""

    def __init__(self) -> None:
        self.rings = Rings()
        self._data = ProcessData()
        self._last_n: int | None = None
        self._heard_s = self._read_s = -math.inf
        self._period_s = self._sample_time_s = 0.0
        self._forget(-math.inf)

    def _forget(self, at_s: float) -> None:
        self._changed_s = at_s
        self._sp, self._mode, self._gains = math.nan, UNKNOWN_MODE, 0
        self._status_known = self._session_known = False
        self._to_read = True

    def interrupted(self) -> None:
        """Notes that frames may be missing from now on: the bus was lost."""
        self._last_n = None

    def began_anew(self) -> None:
        """Drops the history: the clock was put back."""
        self.rings = Rings()
        self._heard_s = self._read_s = -math.inf
        self._last_n = None
        self._forget(-math.inf)

    def take_pv(self, data: bytes, at_s: float) -> None:
        self._data.take_pv(data)

    def take_mv(self, data: bytes, at_s: float) -> None:
        """Takes the MV that completes a sample."""
        sample = self._data.take_mv(data)
        if sample is None or sample[0] == self._last_n:  # a frame may come twice
            return
        n, pv, mv = sample
        silence_s = at_s - self._heard_s
        passed = 0 if self._last_n is None else samples_between(self._last_n, n)
        if passed == 1 and not self._period_s:
            self._period_s = silence_s
        gap = passed != 1 or silence_s > self._silence_s
        if gap:
            self._forget(at_s)
        if passed == 1:  # at most doubled: a single silence is no period
            self._period_s += min(0.125 * (silence_s - self._period_s), self._period_s)
        self._last_n, self._heard_s = n, at_s
        self.rings.put(at_s, n, pv, mv, self._sp, self._gains, self._mode, GAP_BEFORE if gap else 0)

    def take_status(self, data: bytes, at_s: float) -> None:
        """Takes a status, which is sent when something changes."""
        status = self._data
        before = status.on_trial, status.session_is_open
        status.take_status(data)
        if not self._status_known or before != (status.on_trial, status.session_is_open):
            self._gains, self._to_read = 0, True
        self._sp = status.sp
        self._mode = status.mode if status.mode in _MODES else UNKNOWN_MODE
        self._status_known = self._session_known = True
        self._changed_s = at_s

    def learn(self, found: InEffect, now_s: float) -> None:
        """Takes a reading. One that something has overtaken meanwhile is dropped, and the loop is read again."""
        self._sample_time_s = found.sample_time_s
        on_trial_since = self._status_known and found.on_trial != self._data.on_trial
        if self._changed_s >= found.began_s or self.silent_from_s(now_s) < now_s or on_trial_since:
            return
        self._sp, self._mode = found.sp, found.mode if found.mode in _MODES else UNKNOWN_MODE
        self._data.on_trial, self._status_known = found.on_trial, True
        # A job knows them as they were computed, the controller as REAL32.
        gains = found.gains and tuple(shortest(nearest(each)) for each in found.gains)
        self._gains = self.rings.number_of(gains) if gains else 0
        self._read_s, self._to_read = now_s, False

    def to_read(self, now_s: float) -> bool:
        """Returns whether the loop is heard and is to be read."""
        heard = self.silent_from_s(now_s) > now_s
        return heard and (self._to_read or now_s - self._read_s >= READ_AGAIN_S)

    def latest(self, now_s: float) -> Heard | None:
        """Returns what was heard last; None before the first sample."""
        rows = self.rings.since(self.rings.count - 1)
        if not len(rows):
            return None
        return Heard(
            at_s=self._heard_s,
            silent=self.silent_from_s(now_s) < math.inf,
            pv=rows["pv"][-1].item(),
            mv=rows["mv"][-1].item(),
            sp=self._sp,
            mode=self._mode,
            on_trial=self._data.on_trial if self._status_known else None,
            session=self._data.session_is_open if self._session_known else None,
        )

    def silent_from_s(self, now_s: float) -> float:
        """Returns the time of the last sample where further ones are due; infinite while they come."""
        return self._heard_s if now_s - self._heard_s > self._silence_s else math.inf

    @property
    def _silence_s(self) -> float:
        # until two samples have come, the period is the one that the controller reports
        return max(SILENCE_S, 3.0 * (self._period_s or self._sample_time_s))
