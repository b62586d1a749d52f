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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from loopwright.tuning.experiments.primitives import Array
from loopwright.tuning.reasons import FalsePv, Reason

MIN_RENEWALS = 30
"""Number of values, each renewed, that the rest must have for its noise to be known."""
MIN_REVERSALS, MIN_LEVELS, MAX_RUN_PART = 8, 3, 0.25
"""Noise moves PV at rest where it turns round at least so often, has so many values, and is never equal for longer than
this part of the rest. Of two values alone nothing is known of the noise between them."""
RUN_OF_REST, RUN_MORE = 2, 10
"""PV is equal for too long after so many times the longest run at rest and so many samples more."""
RARE, RARE_QUIET = 1e-8, 3e-7
"""Probability, by its noise alone, of what a true PV is taken for false for, in one look: of a run of equal values, and
of a variance that small over one of WINDOWS, which only a PV that stands still can have."""
LONGEST_BY_CHANCE = 120
"""Longest run, in renewals, that is waited for where rounding and noise permit it. Beyond that noise says nothing."""
WINDOWS = (8, 10, 12, 14, 16, 18, 20, 23, 26, 30, 35, 40)
"""Numbers of renewals over which the noise is looked at."""
QUIETER_THAN_REST = 0.5
"""Part of the smallest variance at rest over as many samples, below which that of a false PV is."""
COARSE = 1.0
"""Quantum in noises above which PV may be equal by chance for so long that its variance says nothing."""
LOUD = {15: (4.5, 2.8), 20: (4.0, 2.5), 26: (3.5, 2.3)}
"""PV is too loud where, over so many values, the mean square of what does not lie between its neighbours exceeds this
multiple of the variance at rest, without the OUTLIERS_BETWEEN largest (which a jump, or a wrong sample, makes), and
that of the distance from the median the second one, without the OUTLIERS farthest. Of white noise the first is met by
chance once in 1e5, whatever way PV moves."""
OUTLIERS_BETWEEN, OUTLIERS = 4, 3
LOUD_WINDOW = 15
MOST_SELDOM = 4
"""Number of samples from one value to the next from which on the way of PV may look like noise."""
WHITE = 0.6
"""Smallest ratio of von Neumann of noise around a PV that stands still, without the two largest differences; it is far
smaller where PV moves."""
JUMP_NOISES, JUMP_MOVES = 100.0, 20.0
"""A jump is at least so many noises, and so many times the largest move within a sample so far."""
JUMP_STAYS, JUMP_BAND = 6, 0.25
"""PV has to stay for so many samples within this part of the jump."""
ANSWERED_NOISES, FAR_MORE = 10.0, 3.0
"""Distance from rest, in noises, from which PV has answered MV. The first answer to moves of MV that are so many times
larger than any that it has answered may be as fast as a jump."""
LARGE_NOISES = 8.0
"""Move of PV within a sample, in noises, that is none of its noise."""
QUIET_MORE, LARGE_MOVE = 15, 0.3
"""A PV that noise does not move has to answer a move of MV, of at least this part of MV's largest so far, within twice
the rest's duration, which is no shorter than half of T95, and so many samples more."""
QUANTA_SHOWN = 4.0
"""A move of MV that moves PV by fewer quanta than that may be lost in its rounding."""
STEADY_CHANGES, STEADY_SPEED, STOPPED_RUNS = 12, 0.4, 6
"""It has stopped in the middle of its way where its last changes, so many, went one way, the last no slower than this
part of the fastest, and it is then equal for so many times the longest of their runs and QUIET_MORE samples. At a
turning point it is equal for at most 4.8 times its last run, with a dead band 5.9 times; where noise comes to a coarse
quantum, for longer, and twice as long is waited for."""
LONGEST_REST = 20_000
"""Largest number of samples at rest that are looked at."""


@dataclass(frozen=True, slots=True)
class PvAtRest:
    """What PV does at rest.

    samples: their number.  value, last: the mean and the last of them, PV units; nan where there is none.
    longest_run: the largest number of samples in a row that were exactly equal.
    renewal: the number of samples from one new value to the next.
    noise: the standard deviation of PV around a mean that stands still, PV units; the larger of that by differences and
    that over LOUD_WINDOW values.  least_noise: the smaller of both.
    loud_variance: the variance beside which PV is too loud: that noise squared, and more as it is less well known.
    quantum: the smallest distance of two values, PV units.
    largest_move: the largest move from one sample to the next, PV units.
    run_limit: the number of equal samples in a row from which PV is false; None where noise does not move PV.
    least_variances: for each of WINDOWS, the variance below which PV is false; 0 where that is not known.
    """

    samples: int
    value: float
    last: float
    longest_run: int
    renewal: int
    noise: float
    least_noise: float
    loud_variance: float
    quantum: float
    largest_move: float
    run_limit: int | None
    least_variances: tuple[float, ...]

    @classmethod
    def of(cls, pv: Sequence[float]) -> PvAtRest:
        """pv: consecutive samples at rest, PV units; the last LONGEST_REST are looked at."""
        x = np.asarray(pv[-LONGEST_REST:], dtype=float)
        n = len(x)
        if n < 2:
            value = float(x[0]) if n else math.nan
            return cls(n, value, value, n, 1, 0.0, 0.0, 0.0, 0.0, 0.0, None, (0.0,) * len(WINDOWS))
        edges = np.flatnonzero(np.diff(x)) + 1
        runs = np.diff([0, *edges, n])
        longest = int(runs.max())
        renewal = int(np.quantile(runs[1:-1], 0.1, method="lower")) if len(runs) > 2 else 1
        levels = np.unique(x)
        quantum = float(np.diff(levels).min()) if len(levels) > 1 else 0.0
        moves = np.diff(x[edges]) if len(edges) > 1 else np.zeros(0)
        reversals = int(np.count_nonzero(moves[1:] * moves[:-1] < 0.0))
        values = x[renewal - 1 :: renewal]
        by_differences = 0.5 * float(np.mean(np.diff(values) ** 2)) if len(values) > 1 else 0.0
        variances = {w: _variances(values, w) for w in (*WINDOWS, LOUD_WINDOW) if w <= len(values)}
        over = float(np.mean(variances[LOUD_WINDOW])) if LOUD_WINDOW in variances else by_differences
        largest = float(np.abs(np.diff(x)).max())
        limit: int | None = None
        least = [0.0] * len(WINDOWS)
        moved = reversals >= MIN_REVERSALS and len(levels) >= MIN_LEVELS and longest <= MAX_RUN_PART * n
        if moved and len(values) >= MIN_RENEWALS:
            chance = _longest_by_chance(quantum, by_differences)
            if chance <= LONGEST_BY_CHANCE:
                limit = max(RUN_OF_REST * longest + RUN_MORE, math.ceil(chance * renewal))
            small = min(by_differences, over)
            if quantum <= COARSE * math.sqrt(small):
                for at, w in enumerate(WINDOWS):
                    if w in variances:
                        by_noise = small * float(fdtri(w - 1, len(values) * 2 // 3, RARE_QUIET))
                        least[at] = min(by_noise, QUIETER_THAN_REST * float(variances[w].min()))
        noise, least_noise = (math.sqrt(each(by_differences, over)) for each in (max, min))
        loud = noise**2 * (1.0 + 2.0 / math.sqrt(max(len(values), 1)))
        loud += 0.25 * quantum**2 if quantum > 0.5 * noise else 0.0  # in the middle between two values PV is louder
        return cls(
            samples=n,
            value=float(np.mean(x)),
            last=float(x[-1]),
            longest_run=longest,
            renewal=renewal,
            noise=noise,
            least_noise=least_noise,
            loud_variance=loud,
            quantum=quantum,
            largest_move=largest,
            run_limit=limit,
            least_variances=tuple(least),
        )

    @property
    def lively(self) -> bool:
        """Whether noise moves PV at rest, so that equal values tell."""
        return self.run_limit is not None


def check_end_of_rest(pv: Sequence[float]) -> None:
    """Raises FalsePv, PV_FROZEN, where PV has come to stand still at the end of its rest. pv: the samples, PV units."""
    run = next((n for n, value in enumerate(reversed(pv)) if value != pv[-1]), len(pv))
    before = PvAtRest.of(pv[: len(pv) - run])
    if before.run_limit is not None and run > before.run_limit:
        text = f"where it never stood still for more than {before.longest_run}"
        raise FalsePv(Reason.PV_FROZEN, f"PV is exactly {pv[-1]:.6g} for the last {run} samples at rest, {text}")


def _variances(values: Array, window: int) -> Array:
    variances: Array = np.lib.stride_tricks.sliding_window_view(values, window).var(axis=1, ddof=1)
    return variances


def _longest_by_chance(quantum: float, variance: float) -> float:
    """The run of equal values that noise of this variance (after rounding), rounded to this quantum, leaves by chance
    with the probability RARE where the mean of PV stands in the middle of a quantum."""
    if quantum <= 0.0:
        return 0.0
    noise = math.sqrt(max(variance - quantum**2 / 12.0, 0.0))
    if noise == 0.0:
        return math.inf
    stays = math.erf(quantum / (2.0 * math.sqrt(2.0) * noise))
    return math.log(RARE) / math.log(stays) if stays < 1.0 else math.inf


class PvWatch:
    """Looks at each sample from the first move of a test on.

    rest: what PV did before.  mv: MV at rest, MV units.
    direction: +1 where PV rises with MV, -1 where it falls.
    mv_low, mv_high: MV's limits, MV units.
    """

    def __init__(self, rest: PvAtRest, mv: float, direction: float, mv_low: float, mv_high: float) -> None:
        self._rest, self._mv_home, self._direction = rest, mv, direction
        self._low, self._high = mv_low, mv_high
        self._hair = 1e-3 * abs(mv_high - mv_low) if math.isfinite(mv_high - mv_low) else 0.0
        self._n = 0
        self._last = rest.last
        self._run = 1
        self._longest_run = 0
        """The longest run since the first move of MV that PV has ended."""
        self._answered = 0.0
        """MV's largest distance from home when PV was last away from rest: to so much it has answered."""
        self._largest = rest.largest_move
        self._largest_of_mv = 0.0
        """The largest move of PV within a sample, beyond its noise, over MV's largest distance from home till then."""
        self._jump: _Jump | None = None
        self._farthest_mv = self._farthest_pv = 0.0
        self._least_change = math.inf
        self._moved_mv: tuple[float, int] = (mv, -1)
        """The last move of MV that PV has to answer: MV after it, and its sample."""
        self._answer_due: int | None = None
        """The first such move since PV is equal."""
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
        self._check_jump(pv, mv)
        self._last = pv

    def has_to_show(self, move: float) -> bool:
        """Whether PV has to show a move of MV in spite of its quantum, as far as it has moved in the test so far.

        move: MV units, positive. Of a PV that has not moved yet the answer is True.
        """
        if not self._changes or self._farthest_mv == 0.0:
            return True
        return move * self._farthest_pv > QUANTA_SHOWN * self._least_change * self._farthest_mv

    # equal values

    def _watch_mv(self, mv: float) -> None:
        """Notes moves of MV that are large beside those of the test."""
        self._farthest_mv = max(self._farthest_mv, abs(mv - self._mv_home))
        move = abs(mv - self._moved_mv[0])
        if move > max(LARGE_MOVE * self._farthest_mv, self._hair) and self.has_to_show(move):
            self._moved_mv = (mv, self._n)
            if self._answer_due is None:
                self._answer_due = self._n

    def _ends_run(self, pv: float) -> None:
        if not math.isnan(self._last):
            self._longest_run = max(self._longest_run, self._run)
            self._changes.append((pv - self._last, self._run))
            self._least_change = min(self._least_change, abs(pv - self._last))
            self._farthest_pv = max(self._farthest_pv, abs(pv - self._rest.value))
        self._run, self._answer_due = 1, None

    def _check_run(self, pv: float, mv: float) -> None:
        rest, run = self._rest, self._run
        if rest.run_limit is not None:
            if run > rest.run_limit:
                text = f"where it never stood still for more than {rest.longest_run} at rest"
                raise FalsePv(Reason.PV_FROZEN, f"PV is exactly {pv:.6g} for {run} samples, {text}")
            return
        if not self._changes:
            return  # it has not moved since the test began: no sensor that ends, for all that is known
        longest = max(RUN_OF_REST * rest.samples, RUN_OF_REST * self._longest_run) + QUIET_MORE
        if self._answer_due is not None and self._n - self._answer_due > longest:
            text = f"though MV moved to {self._moved_mv[0]:.4g} meanwhile; before, it answered"
            raise FalsePv(Reason.PV_FROZEN, f"PV is exactly {pv:.6g} for {run} samples, {text}")
        if abs(mv - self._mv_home) > self._hair and self._low + self._hair < mv < self._high - self._hair:
            self._check_stop(pv, mv)

    def _check_stop(self, pv: float, mv: float) -> None:
        """A PV that noise does not move, and that stops from one sample to the next."""
        changes = self._changes
        if len(changes) < STEADY_CHANGES or self._run <= QUIET_MORE:
            return
        longest = max(run for _, run in changes)
        coarse = abs(changes[-1][0]) <= QUANTA_SHOWN * self._least_change
        if self._run <= (2 if coarse else 1) * STOPPED_RUNS * longest + QUIET_MORE:
            return
        sign = math.copysign(1.0, changes[-1][0])
        speeds = [sign * move / run for move, run in changes]
        if min(speeds) > 0.0 and speeds[-1] >= STEADY_SPEED * max(speeds):
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
        for window, least in zip(WINDOWS, rest.least_variances, strict=True):
            if window > count:
                break
            if not least or self._run > (window - 1) * rest.renewal:
                continue  # equal values are told as such
            total = sums[-1] - sums[-1 - window]
            variance = (squares[-1] - squares[-1 - window] - total * total / window) / (window - 1)
            if variance < least:
                self._false_noise(pv, window, math.sqrt(max(variance, 0.0)))
        if count >= LOUD_WINDOW and self._jump is None and rest.renewal <= MOST_SELDOM:
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

    # jumps

    def _check_jump(self, pv: float, mv: float) -> None:
        rest = self._rest
        if self._jump is not None:
            self._go_on_with_jump(self._jump, pv)
            return
        if math.isnan(self._last):
            return
        move = pv - self._last
        known = rest.lively or len(self._changes) == STEADY_CHANGES
        largest = max(self._largest, self._largest_of_mv * self._farthest_mv)
        if known and abs(move) > max(JUMP_NOISES * rest.noise, JUMP_MOVES * largest) > 0.0:
            unknown = self._farthest_mv > FAR_MORE * self._answered
            expected = move * self._direction * (mv - self._mv_home) > 0.0
            if not (unknown and (expected or rest.renewal > 1)):
                self._jump = _Jump(self._last, pv, largest)
                return
        if abs(pv - rest.value) > ANSWERED_NOISES * rest.noise:
            self._answered = self._farthest_mv
        self._moved(abs(move))

    def _moved(self, move: float) -> None:
        """Learns what a true PV moves by within a sample."""
        self._largest = max(self._largest, move)
        if move > LARGE_NOISES * self._rest.noise and self._farthest_mv > 0.0:
            self._largest_of_mv = max(self._largest_of_mv, move / self._farthest_mv)

    def _go_on_with_jump(self, jump: _Jump, pv: float) -> None:
        rest = self._rest
        jump.since += 1
        size = jump.to - jump.before
        if abs(pv - jump.to) > JUMP_BAND * abs(size):
            if abs(pv - jump.before) > JUMP_BAND * abs(size):
                self._moved(abs(size))  # it goes on: a fast plant
            self._jump = None
            return
        ways = 2 * rest.renewal
        if jump.since == ways:
            further = math.copysign(1.0, size) * (pv - jump.to)
            if further > ways * jump.largest_move + 5.0 * rest.noise:
                self._moved(abs(size))
                self._jump = None
                return
        if jump.since >= max(JUMP_STAYS, ways + 1) - 1:
            noises = f"{abs(size) / rest.noise:.0f} noises" if rest.noise else "it has no noise"
            text = f"PV went from {jump.before:.6g} to {jump.to:.6g} within one sample ({noises})"
            moved = (
                f"and has stayed there for {jump.since + 1}; it had never moved by more than {jump.largest_move:.3g}"
            )
            raise FalsePv(Reason.BAD_SAMPLE, f"{text}, {moved} in a sample")


@dataclass(slots=True)
class _Jump:
    """A jump that is looked at.

    before, to: PV before and after it, PV units.  largest_move: the largest move within a sample before, PV units.
    since: the number of samples since.
    """

    before: float
    to: float
    largest_move: float
    since: int = 0
