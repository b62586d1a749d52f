"""Whether PV has jumped as the plant cannot: far within one sample, without the way there that a lag takes, to stay.

A plant whose lag is far shorter than its sample time behind a dead time does jump, once it answers MV. A first answer
in MV's direction is therefore believed at first. It claims that the plant has no lag to speak of, and no more dead time
than had passed by then; so when MV goes home, or beyond, PV has to be back within that time. T95 tells nothing of it:
most of it may be dead time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from loopwright.tuning.experiments.pv_at_rest import PvAtRest
from loopwright.tuning.reasons import FalsePv, Reason

JUMP_NOISES, JUMP_MOVES = 100.0, 20.0
"""A jump is at least so many noises, and so many times the largest move within a sample so far."""
JUMP_STAYS, JUMP_BAND = 6, 0.25
"""PV has to stay for so many samples, and to move by no more than this part of the jump in each of them: behind a lag
of a sample it goes on faster."""
WRONG_SAMPLES = 3
"""Number of wrong samples that are survived."""
ANSWERED_NOISES, FAR_MORE = 10.0, 3.0
"""Distance from rest, in noises, from which PV has answered MV. The first answer to moves of MV that are so many times
larger than any that it has answered may be as fast as a jump."""
LARGE_NOISES = 8.0
"""Move of PV within a sample, in noises, that is none of its noise."""
FURTHER, SLOWER = 0.03, 0.6
"""Part of a jump by which a PV that has not moved before goes on, next, behind a lag of 0.4 samples or more; and the
largest part of that by which it then goes on. A jump of the sensor is followed by the way of a slow plant."""
SELDOM = 20
"""Number of samples for which a PV that has not moved before may stay as it is between two values."""
CAME_BACK = 0.5
"""Part of a jump of which no more is left once a plant that is so fast has answered MV's way home."""


@dataclass(slots=True)
class _Jump:
    """A jump that is looked at.

    before, to: PV before and after it, PV units.  largest_move: the largest move within a sample before, PV units.
    delay: the number of samples in which MV's move is answered, if the plant has moved PV; None where it cannot have.
    side: of home on which MV was.  since: the number of samples since.
    moves: the first two moves since, away from where PV was before, PV units.
    looked: whether PV has been found not to go on.
    home_for: the number of samples for which MV is home again, or beyond.
    """

    before: float
    to: float
    largest_move: float
    delay: int | None
    side: float
    since: int = 0
    moves: list[float] = field(default_factory=list)
    looked: bool = False
    home_for: int = 0

    @property
    def size(self) -> float:
        return abs(self.to - self.before)

    def back(self, pv: float) -> float:
        """How far PV is from where it was before, in the jump's direction, PV units."""
        return math.copysign(1.0, self.to - self.before) * (pv - self.before)


class JumpWatch:
    """Looks at each sample from the first move of a test on.

    rest: what PV did before.  mv: MV at rest, MV units.  hair: what MV is off home by where it is home, MV units.
    direction: +1 where PV rises with MV, -1 where it falls.
    step: the permitted set-point step, PV units: no rounding is so coarse.
    """

    def __init__(self, rest: PvAtRest, mv: float, hair: float, direction: float, step: float) -> None:
        self._rest, self._mv_home, self._hair = rest, mv, hair
        self._direction, self._step = direction, step
        self._n = 0
        self._last = rest.last
        self._renewal: int | None = None
        self._farthest_mv = 0.0
        self._answered = 0.0
        """MV's largest distance from home when PV was last away from rest: to so much it has answered."""
        self._unanswered_since: int | None = None
        """The sample from which MV is so far away that PV's answer to it may be as fast as a jump."""
        self._largest = rest.largest_move
        self._largest_of_mv = 0.0
        """The largest move of PV within a sample, beyond its noise, over MV's largest distance from home till then."""
        self._jump: _Jump | None = None
        self._claim: _Jump | None = None
        """A jump that has stayed, and that the plant may have made."""

    @property
    def looking(self) -> bool:
        """Whether PV has jumped, and it is not known yet whether it stays."""
        return self._jump is not None

    @property
    def undecided(self) -> bool:
        """Whether PV has jumped so few samples ago that they may be wrong ones, or so that the plant may have."""
        jump = self._jump
        return self._claim is not None or (jump is not None and (jump.since < JUMP_STAYS or jump.delay is not None))

    def check(self, pv: float, mv: float, renewal: int | None) -> None:
        """Takes the next sample. Raises FalsePv, BAD_SAMPLE.

        renewal: the number of samples from one value of PV to the next; None where it has not moved yet.
        """
        self._n += 1
        self._renewal = renewal
        self._farthest_mv = max(self._farthest_mv, abs(mv - self._mv_home))
        if self._farthest_mv <= FAR_MORE * self._answered:
            self._unanswered_since = None
        elif self._unanswered_since is None:
            self._unanswered_since = self._n
        if self._claim is not None:
            self._check_claim(self._claim, pv, mv)
        if self._jump is not None:
            self._go_on_with(self._jump, pv, mv)
        elif not math.isnan(self._last):
            self._look_for_one(pv, mv)
        self._last = pv

    def check_end(self) -> None:
        """Raises FalsePv, BAD_SAMPLE, where PV has jumped when the test ends without a result, and is there still."""
        if self._jump is not None and self._jump.since >= WRONG_SAMPLES:
            raise self._false(self._jump, f"and was there for {self._jump.since + 1}, when the test ended")
        if self._claim is not None:
            raise self._false(self._claim, "and has not come back until the test ended")

    def _look_for_one(self, pv: float, mv: float) -> None:
        rest, move, renewal = self._rest, pv - self._last, self._renewal
        largest = max(self._largest, self._largest_of_mv * self._farthest_mv)
        if self._claim is not None:
            largest = max(largest, self._claim.size)
        smallest = max(JUMP_NOISES * rest.noise, JUMP_MOVES * largest, self._step if renewal is None else 0.0)
        since = self._unanswered_since
        if abs(move) > smallest > 0.0 and (since is None or rest.renewal == 1):
            side = math.copysign(1.0, mv - self._mv_home)
            by_mv = since is not None and move * self._direction * side > 0.0
            delay = self._n - since if since is not None and by_mv else None
            self._jump = _Jump(self._last, pv, largest, delay, side)
            return
        if abs(pv - rest.value) > ANSWERED_NOISES * rest.noise and pv != rest.last:
            self._answered = self._farthest_mv
        self._moved(abs(move))

    def _moved(self, move: float) -> None:
        """Learns what a true PV moves by within a sample."""
        self._largest = max(self._largest, move)
        if move > LARGE_NOISES * self._rest.noise and self._farthest_mv > 0.0:
            self._largest_of_mv = max(self._largest_of_mv, move / self._farthest_mv)

    def _believe(self, jump: _Jump) -> None:
        self._moved(jump.size)
        self._answered = self._farthest_mv
        self._jump = None

    def _go_on_with(self, jump: _Jump, pv: float, mv: float) -> None:
        jump.since += 1
        self._count_home(jump, mv)
        move = jump.back(pv) - jump.back(self._last)
        left = jump.back(pv)
        if left <= JUMP_BAND * jump.size or (left <= CAME_BACK * jump.size and jump.since < JUMP_STAYS):
            self._jump = None  # wrong samples
            return
        if abs(move) > JUMP_BAND * jump.size:
            self._believe(jump)  # it goes on: a fast plant
            return
        if move != 0.0 and len(jump.moves) < 2:
            jump.moves.append(move)
        ways = 2 * (self._renewal or SELDOM)
        if jump.since >= ways and not jump.looked:
            jump.looked = True
            if self._goes_on(jump, left, ways):
                self._believe(jump)
                return
        if jump.since < max(JUMP_STAYS, ways + 1) - 1:
            return
        if jump.delay is None and self._renewal is None:
            return  # how often PV is renewed is not known: only the end of the test tells
        if jump.delay is None:
            raise self._false(jump, f"and has stayed there for {jump.since + 1}")
        self._jump, self._claim = None, jump

    def _goes_on(self, jump: _Jump, left: float, ways: int) -> bool:
        """Whether PV has gone further, so many samples after a jump, as it does behind a lag."""
        if jump.largest_move > 0.0:
            return left - jump.size > ways * jump.largest_move + 5.0 * self._rest.noise
        first, then = [*jump.moves, 0.0, 0.0][:2]
        return first > FURTHER * jump.size and abs(then) <= SLOWER * first

    def _count_home(self, jump: _Jump, mv: float) -> None:
        jump.home_for = jump.home_for + 1 if jump.side * (mv - self._mv_home) <= self._hair else 0

    def _check_claim(self, jump: _Jump, pv: float, mv: float) -> None:
        if jump.back(pv) <= CAME_BACK * jump.size:
            self._claim = None
            self._believe(jump)
            return
        self._count_home(jump, mv)
        answered = 2 * (self._renewal or SELDOM) + WRONG_SAMPLES
        if jump.delay is not None and jump.home_for > jump.delay + answered:
            text = f"and has not answered in the {jump.home_for} since MV is back at {mv:.4g}, as a plant so fast does"
            raise self._false(jump, text)

    def _false(self, jump: _Jump, what_then: str) -> FalsePv:
        noise = self._rest.noise
        noises = f"{jump.size / noise:.0f} noises" if noise else "it has no noise"
        text = f"PV went from {jump.before:.6g} to {jump.to:.6g} within one sample ({noises})"
        before = f"it had never moved by more than {jump.largest_move:.3g} in a sample"
        return FalsePv(Reason.BAD_SAMPLE, f"{text}, {what_then}; {before}")
