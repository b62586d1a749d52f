"""Which numbers can be those of a plant. What is far outside is refused by name, before anything is computed with it.

Beyond these limits an input is a slip of the hand or a mistaken unit, and answers would be worth nothing: a double has
16 digits, of which lags that differ by a factor of a million leave few to compute with, and what simulates or searches
takes as many steps as the longest time has shortest ones. Real plants, the 121 of the benchmarks and every case of the
five papers lie well inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

MIN_TIME_S, MAX_TIME_S = 1e-6, 1e8
"""From a microsecond, the unit of a controller's sample time, to three years."""
MIN_GAIN, MAX_GAIN = 1e-9, 1e9
"""PV units over MV units, or the other way round: from flows in m3/s to pressures in Pa."""
MAX_VALUE = 1e12
"""Of PV, in its units."""
SPREAD = 1e5
"""Of a plant's time constants. The stiffest plant of the benchmarks has 1e3."""
MIN_DEAD_TIME, MAX_DEAD_TIME = 1e-5, 1e3
"""Over the longest time constant. The benchmarks have 1e-3 to 50; a shorter one is none."""
SPREAD_OF_ZEROS = 1e9
"""Of a zero that is faster than every lag: fits leave such, and they do no harm."""
MIN_DAMPING = 1e-3
MAX_SAMPLES = 200_000
"""In T95 or in the dead time: of more, a rehearsal takes minutes."""
MIN_STEP = 1e-6
"""Of a set-point step, over the largest PV: values travel as REAL32, which has 7 digits."""
_LARGEST_COEFFICIENT = 1e100


Reals = NDArray[np.float64]


class Implausible(ValueError):
    """The message names the quantity, its value, what is permitted and what to do."""


def check_model(num: Sequence[float], den: Sequence[float], dead_time_s: float) -> None:
    """Of a transfer function, coefficients by falling powers of s. Raises Implausible."""
    above, below = np.trim_zeros(np.asarray(num, float), "f"), np.trim_zeros(np.asarray(den, float), "f")
    if not len(above) or not len(below):
        return  # no transfer function: others say so
    for name, coefficients in (("num", above), ("den", below)):
        sizes = np.abs(coefficients[coefficients != 0.0])
        if not (
            np.isfinite(sizes).all()
            and 1.0 / _LARGEST_COEFFICIENT <= sizes.min() <= sizes.max() <= _LARGEST_COEFFICIENT
        ):
            raise Implausible(
                f"gain and times give {name} coefficients of {sizes.min():.3g} to {sizes.max():.3g}; permitted are "
                f"{1.0 / _LARGEST_COEFFICIENT:g} to {_LARGEST_COEFFICIENT:g}: correct them, or choose other units"
            )
    lags, leads = _time_constants(below), _time_constants(above)
    _check_gain(above, below, lags, dead_time_s)
    _check_times(lags, leads, dead_time_s)


def _time_constants(coefficients: Reals) -> Reals:
    """1/|p| of every root but those at the origin, s, the longest first."""
    sizes = np.abs(np.roots(coefficients))
    found: Reals = np.sort(1.0 / sizes[sizes > 0.0])[::-1]
    return found


def _check_gain(num: Reals, den: Reals, lags: Reals, dead_time_s: float) -> None:
    at_the_end = np.trim_zeros(den, "b")
    gain = abs(float(num[-1] / at_the_end[-1]))  # 0: PV comes back, which others refuse
    if len(at_the_end) < len(den):  # integrating: what PV moves in the plant's own time
        gain *= max([dead_time_s, *lags]) or 1.0
    if gain and not MIN_GAIN <= gain <= MAX_GAIN:
        raise Implausible(
            f"a gain of {gain:.3g} PV units per MV unit is no plant's; permitted are {MIN_GAIN:g} to {MAX_GAIN:g}: "
            "look whether K is given per percent of MV, or choose another unit of PV"
        )


def _check_times(lags: Reals, leads: Reals, dead_time_s: float) -> None:
    for name, value in (*(("time constant", lag) for lag in lags), ("dead time", dead_time_s)):
        if value and not MIN_TIME_S <= value <= MAX_TIME_S:
            raise Implausible(
                f"a {name} of {value:.3g} s is no plant's; permitted are {MIN_TIME_S:g} to {MAX_TIME_S:g} s: "
                "look whether times are in seconds"
            )
    if not len(lags):
        return
    longest, shortest = float(lags[0]), float(lags[-1])
    if longest > SPREAD * shortest:
        raise Implausible(
            f"time constants of {shortest:.3g} s and {longest:.3g} s differ by a factor {longest / shortest:.3g}; "
            f"permitted is {SPREAD:g}: leave the short one out, which nobody could see beside the long one"
        )
    for lead in leads:
        if not longest / SPREAD_OF_ZEROS <= lead <= longest * SPREAD:
            raise Implausible(
                f"a zero of {lead:.3g} s beside a time constant of {longest:.3g} s; permitted are "
                f"{longest / SPREAD_OF_ZEROS:.3g} to {longest * SPREAD:.3g} s: leave it out, or correct num"
            )
    minimum, maximum = MIN_DEAD_TIME * longest, MAX_DEAD_TIME * longest
    if dead_time_s and not minimum <= dead_time_s <= maximum:
        what = "give 0" if dead_time_s < minimum else "correct it, or the time constants"
        raise Implausible(
            f"a dead time of {dead_time_s:.3g} s beside a time constant of {longest:.3g} s; permitted are 0, and "
            f"{minimum:.3g} to {maximum:.3g} s: {what}"
        )


def check_option(name: str, unit: str, value: object) -> None:
    """Of a method. Raises Implausible."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value == 0:
        return
    low, high = (MIN_TIME_S, MAX_TIME_S) if unit == "s" else (MIN_GAIN, MAX_GAIN)
    if not low <= abs(value) <= high:
        raise Implausible(f"{name} {value:.4g} is out of all bounds; permitted are 0, and {low:g} to {high:g} {unit}")


def check_damping(zeta: float) -> None:
    """Raises Implausible."""
    if zeta < MIN_DAMPING:
        raise Implausible(
            f"zeta {zeta:.3g} is no plant's: it hardly ever comes to rest; permitted are {MIN_DAMPING:g} and more"
        )


def check_sampling(dead_time_s: float, t95_s: float, sample_time_s: float) -> None:
    """Of a plant to rehearse on. Raises Implausible."""
    if not MIN_TIME_S <= t95_s <= MAX_TIME_S:
        raise Implausible(f"t95_s {t95_s:.3g}; permitted are {MIN_TIME_S:g} to {MAX_TIME_S:g} s: correct t95_s")
    check_dead_time(dead_time_s, t95_s)
    if not MIN_TIME_S <= sample_time_s <= t95_s:
        raise Implausible(
            f"sample_time_s {sample_time_s:.3g} with a T95 of {t95_s:.3g} s; permitted are {MIN_TIME_S:g} s to T95: "
            "a loop is controlled at a hundredth of T95 or faster"
        )
    for name, time_s in (("T95", t95_s), ("the dead time", dead_time_s)):
        if time_s > MAX_SAMPLES * sample_time_s:
            raise Implausible(
                f"sample_time_s {sample_time_s:g} is {time_s / sample_time_s:.3g} times in {name} ({time_s:.4g} s); "
                f"at most {MAX_SAMPLES:,} are allowed: sample more slowly, or correct that time"
            )


def check_dead_time(dead_time_s: float, t95_s: float) -> None:
    """Of a plant to rehearse on, beside the T95 of its loop. Raises Implausible."""
    if dead_time_s > 10.0 * t95_s:
        raise Implausible(
            f"a dead time of {dead_time_s:.3g} s with a T95 of {t95_s:.3g} s, in which it is contained; permitted are "
            f"{10.0 * t95_s:.3g} s: correct t95_s"
        )


def check_step(sp_deviation: float, pv_low: float, pv_high: float) -> None:
    """Raises Implausible."""
    largest = max(abs(pv_low), abs(pv_high))
    if sp_deviation < MIN_STEP * largest:
        raise Implausible(
            f"sp_deviation {sp_deviation:.3g} is lost beside PV limits of {largest:.3g}: PV has 7 digits on the bus; "
            f"at least {MIN_STEP * largest:.3g} is needed: correct it or the limits"
        )


def _within(low: float, high: float, unit: str) -> AfterValidator:
    def check(value: float) -> float:
        if value and not low <= abs(value) <= high:
            raise Implausible(f"{value:.4g} is no plant's; permitted are {low:g} to {high:g} {unit}")
        return value

    return AfterValidator(check)


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Time = Annotated[Positive, _within(MIN_TIME_S, MAX_TIME_S, "s")]
TimeOrNone = Annotated[NotNegative, _within(MIN_TIME_S, MAX_TIME_S, "s, or 0")]
Gain = Annotated[Positive, _within(MIN_GAIN, MAX_GAIN, "PV and MV units over each other")]
Value = Annotated[Finite, _within(0.0, MAX_VALUE, "in units of PV")]
Size = Annotated[NotNegative, _within(0.0, MAX_VALUE, "in units of PV")]
