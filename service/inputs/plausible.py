"""Limits of plausible numbers for a plant. An input outside them is refused before anything is computed with it.

An input beyond these limits is a typing error or a wrong unit, and results would be worthless: a double has 16 digits,
of which time constants that differ by a factor of a million leave few, and simulations and searches take a number of
steps proportional to the ratio of the longest to the shortest time. Real plants, the 121 plants of the benchmarks and
every case of the five papers lie well inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field

MIN_TIME_S, MAX_TIME_S = 1e-6, 1e8
"""The range is from a microsecond, the unit of a controller's sampling period, to three years."""
MIN_GAIN, MAX_GAIN = 1e-9, 1e9
"""The range of a gain, in PV units per MV unit or the inverse, covers flows in m3/s and pressures in Pa."""
MAX_VALUE = 1e12
"""Maximum of |PV|, PV units."""
SPREAD = 1e5
"""Maximum ratio of two time constants of a plant. The stiffest plant of the benchmarks has 1e3."""
MIN_DEAD_TIME, MAX_DEAD_TIME = 1e-5, 1e3
"""Range of the dead time over the longest time constant, apart from 0. The benchmarks have 1e-3 to 50."""
SPREAD_OF_ZEROS = 1e9
"""Maximum ratio of the longest lag to the time constant of a zero. Fits leave fast zeros, which do no harm."""
MIN_DAMPING = 1e-3
MAX_SAMPLES = 200_000
"""Maximum of sampling periods in T95 or in the dead time. A rehearsal with more takes minutes."""
MIN_STEP = 1e-6
"""Minimum of a set-point step over the largest |PV|: the bus transmits REAL32 values, which have 7 digits."""
_LARGEST_COEFFICIENT = 1e100


Reals = NDArray[np.float64]


class Implausible(ValueError):
    """A number is not plausible. The message names the quantity, its value, the permitted range and what to do."""


def check_model(num: Sequence[float], den: Sequence[float], dead_time_s: float) -> None:
    """Raises Implausible for a transfer function outside the limits. Coefficients are by falling powers of s."""
    above, below = np.trim_zeros(np.asarray(num, float), "f"), np.trim_zeros(np.asarray(den, float), "f")
    if not len(above) or not len(below):
        return  # not a transfer function; other validators refuse it
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
    """1/|p| of every root except those at the origin, s, longest first."""
    sizes = np.abs(np.roots(coefficients))
    found: Reals = np.sort(1.0 / sizes[sizes > 0.0])[::-1]
    return found


def _check_gain(num: Reals, den: Reals, lags: Reals, dead_time_s: float) -> None:
    at_the_end = np.trim_zeros(den, "b")
    gain = abs(float(num[-1] / at_the_end[-1]))  # 0 is refused by other validators
    if len(at_the_end) < len(den):  # integrating: the change of PV within the longest time of the plant
        gain *= max([dead_time_s, *lags]) or 1.0
    if gain and not MIN_GAIN <= gain <= MAX_GAIN:
        raise Implausible(
            f"a gain of {gain:.3g} PV units per MV unit is not plausible; permitted are {MIN_GAIN:g} to {MAX_GAIN:g}: "
            "check that K is given per percent of MV, or choose another unit of PV"
        )


def _check_times(lags: Reals, leads: Reals, dead_time_s: float) -> None:
    for name, value in (*(("time constant", lag) for lag in lags), ("dead time", dead_time_s)):
        if value and not MIN_TIME_S <= value <= MAX_TIME_S:
            raise Implausible(
                f"a {name} of {value:.3g} s is not plausible; permitted are {MIN_TIME_S:g} to {MAX_TIME_S:g} s: "
                "check that times are in seconds"
            )
    if not len(lags):
        return
    longest, shortest = float(lags[0]), float(lags[-1])
    if longest > SPREAD * shortest:
        raise Implausible(
            f"time constants of {shortest:.3g} s and {longest:.3g} s differ by a factor {longest / shortest:.3g}; "
            f"permitted is {SPREAD:g}: leave out the short one, whose effect cannot be measured beside the long one"
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
    """Raises Implausible for the value of a method's option that is out of range."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value == 0:
        return
    low, high = (MIN_TIME_S, MAX_TIME_S) if unit == "s" else (MIN_GAIN, MAX_GAIN)
    if not low <= abs(value) <= high:
        raise Implausible(f"{name} {value:.4g} is out of all bounds; permitted are 0, and {low:g} to {high:g} {unit}")


def check_damping(zeta: float) -> None:
    """Raises Implausible for a damping ratio below the minimum."""
    if zeta < MIN_DAMPING:
        raise Implausible(
            f"zeta {zeta:.3g} is not plausible: PV would hardly come to rest; permitted are {MIN_DAMPING:g} and more"
        )


def check_sampling(dead_time_s: float, t95_s: float, sample_time_s: float) -> None:
    """Raises Implausible for times with which a plant cannot be rehearsed."""
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
    """Raises Implausible for a dead time of a rehearsed plant that is too long for the T95 of the loop."""
    if dead_time_s > 10.0 * t95_s:
        raise Implausible(
            f"a dead time of {dead_time_s:.3g} s with a T95 of {t95_s:.3g} s, which includes the dead time; at most "
            f"{10.0 * t95_s:.3g} s are permitted: correct t95_s"
        )


def check_step(sp_deviation: float, pv_low: float, pv_high: float) -> None:
    """Raises Implausible for a set-point step that REAL32 values cannot resolve within these PV limits."""
    largest = max(abs(pv_low), abs(pv_high))
    if sp_deviation < MIN_STEP * largest:
        raise Implausible(
            f"sp_deviation {sp_deviation:.3g} is lost beside PV limits of {largest:.3g}: PV has 7 digits on the bus; "
            f"at least {MIN_STEP * largest:.3g} is needed: correct it or the limits"
        )


def _within(low: float, high: float, unit: str) -> AfterValidator:
    def check(value: float) -> float:
        if value and not low <= abs(value) <= high:
            raise Implausible(f"{value:.4g} is not plausible; permitted are {low:g} to {high:g} {unit}")
        return value

    return AfterValidator(check)


def not_bool(value: object) -> object:
    """Raises ValueError for true and false, which Python would count as 1 and 0."""
    if isinstance(value, bool):
        raise ValueError(f"a number is expected, not {str(value).lower()}")
    return value


_Number = Annotated[float, BeforeValidator(not_bool)]
SetpointWeight = Annotated[_Number, Field(ge=0.0, le=2.0, allow_inf_nan=False)]
Finite = Annotated[_Number, Field(allow_inf_nan=False)]
Positive = Annotated[_Number, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[_Number, Field(ge=0, allow_inf_nan=False)]
Time = Annotated[Positive, _within(MIN_TIME_S, MAX_TIME_S, "s")]
TimeOrNone = Annotated[NotNegative, _within(MIN_TIME_S, MAX_TIME_S, "s, or 0")]
Gain = Annotated[Positive, _within(MIN_GAIN, MAX_GAIN, "PV and MV units over each other")]
Value = Annotated[Finite, _within(0.0, MAX_VALUE, "in units of PV")]
Size = Annotated[NotNegative, _within(0.0, MAX_VALUE, "in units of PV")]
