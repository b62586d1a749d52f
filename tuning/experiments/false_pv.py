"""A PV that is false within its limits, told sample by sample: it stands still, changes its noise, or jumps, as the
plant cannot.

What PV does at rest is learned first (`PvAtRest`): how long it stays exactly equal, how often it is renewed, its noise
and its quantum. A test then hands over each sample (`PvWatch`), and hears at once where PV is

- exactly equal for far longer than ever at rest, where its noise moves it;
- still, with noise far below or far above its own;
- elsewhere within one sample, by hundreds of noises and far more than it ever moved, without the way there that a lag
  takes, and stays there for longer than a few wrong samples do.

Of a PV without noise, or rounded so coarsely that noise does not move it, equal values say little: it is false where
it does not answer a move of MV in a time that no dead time takes, or stops from one sample to the next in the middle of
its way, with MV away from where PV was at rest. What is not told by that the test's own waits have to bound.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

import numpy as np

from loopwright.tuning.experiments.pv_at_rest import LOUD_WINDOW, RUN_OF_REST, WINDOWS, PvAtRest
from loopwright.tuning.experiments.pv_jump import JumpWatch
from loopwright.tuning.reasons import FalsePv, Reason

LOUD = {15: (4.5, 2.8), 20: (4.0, 2.5), 26: (3.5, 2.3)}
"""PV is too loud where, over so many values, the mean square of what does not lie between its neighbours exceeds this
multiple of the variance at rest, without the OUTLIERS_BETWEEN largest (which a jump, or a wrong sample, makes), and
that of the distance from the median the second one, without the OUTLIERS farthest. Of white noise the first is met by
chance once in 1e5, whatever way PV moves. Lower ones took a true PV at its turning points for false."""
OUTLIERS_BETWEEN, OUTLIERS = 4, 3
LONGEST_RENEWAL = 4
"""Number of samples from one value to the next from which on the way of PV may look like noise."""
WHITE = 0.6
"""Smallest ratio of von Neumann of noise around a PV that stands still, without the two largest differences; it is far
smaller where PV moves."""
MORE_SAMPLES, LARGE_MOVE = 15, 0.3
"""A PV that noise does not move has to answer a move of MV, of at least this part of MV's largest so far, within twice
the rest's duration, which is no shorter than half of T95, and so many samples more."""
QUANTA_SHOWN = 4.0
"""A move of MV that moves PV by fewer quanta than that may be lost in its rounding."""
STEADY_CHANGES, STEADY_SPEED, STOPPED_RUNS = 12, 0.4, 6
"""It has stopped in the middle of its way where its last changes, so many, went one way, the last no slower than this
part of the fastest, and it is then equal for so many times the longest of their runs and MORE_SAMPLES samples. At a
turning point it is equal for at most 4.8 times its last run, with a dead band 5.9 times; where noise comes to a coarse
quantum, for longer, and twice as long is waited for."""
GRADUAL_CHANGES, GRADUAL_SPEED, SAME_MOVE = 3, 0.5, 1e-6
"""So has it where so few changes went one way, each no slower than this part of the one before, and the last was more
than QUANTA_SHOWN quanta: behind a lag such a PV has at least that move still before it. Moves that differ by less than
that part are equal."""


class PvWatch:
    """Looks at each sample from the first move of a test on.

    rest: what PV did before.  mv: MV at rest, MV units.
    direction: +1 where PV rises with MV, -1 where it falls.
    mv_low, mv_high: MV's limits, MV units.
    step: the permitted set-point step, PV units.
    """

    def __init__(
        self, rest: PvAtRest, mv: float, direction: float, mv_low: float, mv_high: float, step: float = math.inf
    ) -> None:
        self._rest, self._mv_home = rest, mv
        self._low, self._high = mv_low, mv_high
        self._hair = 1e-3 * abs(mv_high - mv_low) if math.isfinite(mv_high - mv_low) else 0.0
        self._n = 0
        self._last = rest.last
        self._run = 1
        self._longest_run = 0
        """The longest run since the first move of MV that PV has ended."""
        self._jumps = JumpWatch(rest, mv, self._hair, direction, step)
        self._farthest_mv = self._farthest_pv = 0.0
        self._smallest_change = self._quantum = math.inf
        """The smallest move of PV within a sample, and of these and their differences, PV units."""
        self._off_home = 0
        """The number of samples for which MV is away from home."""
        self._moved_mv: tuple[float, int] = (mv, -1)
        """The last move of MV that PV has to answer: MV after it, and its sample."""
        self._answer_due: int | None = None
        """The first such move since PV is equal."""
        self._unanswered: int | None = None
        """The first large move of MV since then, whether or not PV has to show it."""
        self._changes: deque[tuple[float, int]] = deque(maxlen=STEADY_CHANGES)
        """The last moves of PV, and the number of samples for which it was equal before each."""
        length = max(WINDOWS) + 1
        self._values: deque[float] = deque(maxlen=max(LOUD))
        self._sums: deque[float] = deque([0.0], maxlen=length)
        self._squares: deque[float] = deque([0.0], maxlen=length)

    def check(self, pv: float, mv: float) -> None:
        """Takes the next sample. Raises FalsePv: PV_FROZEN, BAD_SAMPLE."""
        self._n += 1
        self._watch_mv(mv)
        equal = pv == self._last
        if equal:
            self._run += 1
            self._check_run(pv, mv)
        else:
            self._ends_run(pv)
        if self._rest.lively and (self._n - 1) % self._rest.renewal == 0:
            self._check_noise(pv)
        self._jumps.check(pv, mv, self._renewal())
        self._last = pv

    @property
    def undecided(self) -> bool:
        """Whether a few more samples tell whether PV is false."""
        return self._jumps.undecided

    def check_end(self) -> None:
        """Looks at PV once more where the test ends without a result. Raises FalsePv: PV_FROZEN, BAD_SAMPLE.

        A test that waits for PV in vain ends by its own rules, and they may be sooner than those that tell PV to be
        false while it goes on.
        """
        self._jumps.check_end()
        due = self._unanswered
        if self._rest.lively or self._changes or due is None:
            return
        since = self._n - due
        if since > RUN_OF_REST * self._rest.samples + MORE_SAMPLES:
            text = f"PV is exactly {self._last:.6g}, as it was before the test, for {since} samples since MV moved"
            raise FalsePv(Reason.PV_FROZEN, f"{text}: the sensor has ended, or MV moves nothing")

    def _renewal(self) -> int | None:
        """The number of samples from one value of PV to the next; None where that is not known."""
        if self._rest.lively or len(self._changes) < STEADY_CHANGES:
            return self._rest.renewal if self._rest.lively else None
        return sorted(run for _, run in self._changes)[STEADY_CHANGES // 2]

    def has_to_show(self, move: float) -> bool:
        """Whether PV has to show a move of MV in spite of its quantum, as far as it has moved in the test so far.

        move: MV units, positive. Of a PV that has not moved yet the answer is True.
        """
        if not self._changes or self._farthest_mv == 0.0:
            return True
        return move * self._farthest_pv > QUANTA_SHOWN * self._smallest_change * self._farthest_mv

    # equal values

    def _watch_mv(self, mv: float) -> None:
        """Notes moves of MV that are large beside those of the test."""
        self._farthest_mv = max(self._farthest_mv, abs(mv - self._mv_home))
        self._off_home = self._off_home + 1 if abs(mv - self._mv_home) > self._hair else 0
        move = abs(mv - self._moved_mv[0])
        large = move > max(LARGE_MOVE * self._farthest_mv, self._hair)
        if large and self._unanswered is None:
            self._unanswered = self._n
        if large and self.has_to_show(move):
            self._moved_mv = (mv, self._n)
            if self._answer_due is None:
                self._answer_due = self._n

    def _ends_run(self, pv: float) -> None:
        if not math.isnan(self._last):
            self._longest_run = max(self._longest_run, self._run)
            self._changes.append((pv - self._last, self._run))
            self._learn_quantum(abs(pv - self._last))
            self._farthest_pv = max(self._farthest_pv, abs(pv - self._rest.value))
        self._run, self._answer_due, self._unanswered = 1, None, None

    def _learn_quantum(self, move: float) -> None:
        self._smallest_change = min(self._smallest_change, move)
        differs = abs(move - abs(self._changes[-2][0])) if len(self._changes) > 1 else 0.0
        self._quantum = min(self._quantum, move, differs if differs > SAME_MOVE * move else move)

    def _check_run(self, pv: float, mv: float) -> None:
        rest, run = self._rest, self._run
        if rest.run_limit is not None:
            if run > rest.run_limit:
                text = f"where it never stood still for more than {rest.longest_run} at rest"
                raise FalsePv(Reason.PV_FROZEN, f"PV is exactly {pv:.6g} for {run} samples, {text}")
            return
        if not self._changes:
            return  # it has not moved since the test began: no sensor that ends, for all that is known
        longest = max(RUN_OF_REST * rest.samples, RUN_OF_REST * self._longest_run) + MORE_SAMPLES
        if self._answer_due is not None and self._n - self._answer_due > longest:
            text = f"though MV moved to {self._moved_mv[0]:.4g} meanwhile; before, it answered"
            raise FalsePv(Reason.PV_FROZEN, f"PV is exactly {pv:.6g} for {run} samples, {text}")
        if self._off_home and self._low + self._hair < mv < self._high - self._hair:
            self._check_stop(pv, mv)

    def _check_stop(self, pv: float, mv: float) -> None:
        """A PV that noise does not move, and that stops from one sample to the next."""
        if self._run <= MORE_SAMPLES or len(self._changes) < GRADUAL_CHANGES:
            return
        sign = math.copysign(1.0, self._changes[-1][0])
        speeds = [sign * move / run for move, run in self._changes]
        last = abs(self._changes[-1][0])
        steady = min(speeds) > 0.0 and speeds[-1] >= STEADY_SPEED * max(speeds)
        changes = list(self._changes)
        if not (steady and len(changes) == STEADY_CHANGES):
            changes, speeds = changes[-GRADUAL_CHANGES:], speeds[-GRADUAL_CHANGES:]
            gradual = min(speeds) > 0.0 and all(b >= GRADUAL_SPEED * a for a, b in pairwise(speeds))
            if not gradual or last <= QUANTA_SHOWN * self._quantum:
                return
        longest = max(run for _, run in changes)
        coarse = last <= QUANTA_SHOWN * self._smallest_change and len(changes) == STEADY_CHANGES
        waited = (2 if coarse else 1) * STOPPED_RUNS * longest + MORE_SAMPLES
        if self._off_home < self._run + self._longest_run:  # it may have come to rest with MV, and wait for an answer
            waited = max(waited, RUN_OF_REST * self._longest_run + MORE_SAMPLES)
        if self._run > waited:
            way = sum(move for move, _ in changes)
            text = f"after it had moved by {way:+.4g} in {sum(run for _, run in changes)}, with MV still at {mv:.4g}"
            raise FalsePv(Reason.PV_FROZEN, f"PV is exactly {pv:.6g} for {self._run} samples, {text}")

    # noise

    def _check_noise(self, pv: float) -> None:
        rest = self._rest
        x = pv - rest.value
        self._values.append(x)
        sums, squares = self._sums, self._squares
        sums.append(sums[-1] + x)
        squares.append(squares[-1] + x * x)
        count = len(sums) - 1
        for window, smallest in zip(WINDOWS, rest.smallest_variances, strict=True):
            if window > count:
                break
            if not smallest or self._run > (window - 1) * rest.renewal:
                continue  # equal values are told as such
            total = sums[-1] - sums[-1 - window]
            variance = (squares[-1] - squares[-1 - window] - total * total / window) / (window - 1)
            if variance < smallest:
                self._false_noise(pv, window, math.sqrt(max(variance, 0.0)))
        if count >= LOUD_WINDOW and not self._jumps.looking and rest.renewal <= LONGEST_RENEWAL:
            self._check_loud(pv)

    def _check_loud(self, pv: float) -> None:
        """Looks at the noise where the plain variance is large at all, which the way of PV makes large too."""
        usual = self._rest.loud_variance
        total = self._sums[-1] - self._sums[-1 - LOUD_WINDOW]
        squares = self._squares[-1] - self._squares[-1 - LOUD_WINDOW]
        if squares - total * total / LOUD_WINDOW < LOUD_WINDOW * usual:
            return
        values = np.asarray(self._values)
        for window, (between, around) in LOUD.items():
            if window > len(values):
                return
            x = values[-window:]
            steps = np.diff(x)
            off = np.sort((0.5 * np.diff(steps)) ** 2)[: window - 2 - OUTLIERS_BETWEEN]
            if float(np.mean(off)) < between * usual:
                continue
            away = np.sort((x - np.median(x)) ** 2)[: window - OUTLIERS]
            white = np.sort(steps**2)[: window - 3]
            around_mean = float(np.sum((x - np.mean(x)) ** 2))
            if float(np.mean(away)) > around * usual and float(np.sum(white)) > WHITE * around_mean:
                self._false_noise(pv, window, math.sqrt(around_mean / (window - 1)))

    def _false_noise(self, pv: float, values: int, noise: float) -> None:
        rest = self._rest
        mean = rest.value + (self._sums[-1] - self._sums[-1 - values]) / values
        text = f"PV stands at {mean:.6g} for {values * rest.renewal} samples"
        shown = f"with noise of {noise:.3g}, {noise / rest.noise:.2g} times that at rest ({rest.noise:.3g})"
        raise FalsePv(Reason.PV_FROZEN, f"{text}, {shown}")
