"""From the lines of a file to evenly spaced samples: order, values that are missing, gaps, resampling.

Whatever is changed is said in a note; what cannot be repaired without inventing the loop is an error.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from loopwright.service.offline.csv_record.errors import Unusable, counted, number_of
from loopwright.tuning.identification.record import GAP, UNEVEN
from loopwright.tuning.models import Reals

Whole = NDArray[np.intp]

MAX_GAP = 3
"""Largest number of samples missing in a row that are filled."""
MAX_FILLED = 0.05
"""Largest part of the samples that is filled."""
MAX_TWICE = 0.02
"""Largest part of the lines that may have the time of the line before and another MV or set-point: a move that was
logged before and after. One such line is always permitted."""
MAX_SAMPLES = 10_000_000
MIN_CHANGES, MAX_REPEATED, MIN_BY_ONE = 10, 0.1, 0.3
"""Of a sensor that sends changes alone: the smallest number of them, the largest part of the values that repeat the one
before, and the smallest part of the changes that are of one step of its resolution."""
_HOUR = 3600.0
_IN_UTC = "export the times in UTC, or with their offset from it"
_NEEDED = ("u", "y")
"""The columns by which a sample is missing."""
_HELD = ("u", "sp")
"""What holds its value until the next sample; PV goes on in a straight line."""
_DURATION = re.compile(r"^\s*(?P<number>(?![1-9]\d{0,2},\d{3}(?!\d))\d+(?:[.,]\d+)?)\s*(?P<unit>ms|s|sec|min|m|h)?\s*$")
_SECONDS = {"ms": 1e-3, "s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


@dataclass(frozen=True, slots=True)
class EvenSamples:
    """Samples in the order of their times. t: s, shape (N,). columns: the values, each of shape (N,). notes: what was
    changed, one sentence each. u_before: MV before the first sample, where the file shows it."""

    t: Reals
    columns: dict[str, Reals]
    notes: tuple[str, ...]
    u_before: float | None = None


def duration(text: str) -> float:
    """Returns the seconds of "5s", "500 ms", "1 min" or "5". Raises ValueError."""
    found = _DURATION.match(text)
    value = float(found["number"].replace(",", ".")) * _SECONDS[found["unit"] or "s"] if found else 0.0
    if not value > 0.0:
        raise ValueError(f"a time such as 5s, 500ms or 1min is expected, not {text!r}")
    return value


def sampled(
    t: Reals, columns: Mapping[str, Reals], lines: Sequence[int], resample_s: float | None, hold: bool | None = None
) -> EvenSamples:
    """Returns the samples of a record.

    t: the times as they stand in the file, s, shape (N,). columns: MV `u`, PV `y` and perhaps `sp`, NaN where there is
    no value. lines: the number of the line of each sample. resample_s: the sample time asked for, s, or None for that
    of the file. hold: whether PV holds its value where samples are made; None: as the values show. Raises Unusable.
    """
    notes: list[str] = []
    order = np.arange(len(t))
    if len(t) > 1 and np.all(np.diff(t) <= 0.0) and t[-1] < t[0]:
        order = order[::-1]
        notes.append("The file has its latest sample first; the record begins with the last line.")
    t, at = t[order], np.asarray(lines, dtype=np.intp)[order]
    values = {name: column[order] for name, column in columns.items()}
    keep = _without_repeated(t, values, at, notes)
    u_before = float(values["u"][0]) if keep[0] != 0 and np.isfinite(values["u"][0]) else None
    t, at = t[keep], at[keep]
    values = {name: column[keep] for name, column in values.items()}
    if order[0] != 0 and t[0] < 0.0:
        t = t - t[0]  # dates count from the first line
    if resample_s is not None:
        return replace(_resampled(t, values, resample_s, hold, notes), u_before=u_before)
    t, values = _rows_filled_in(t, values, at)
    return replace(_filled(t, values, notes), u_before=u_before)


def _without_repeated(t: Reals, values: dict[str, Reals], lines: Whole, notes: list[str]) -> list[int]:
    """The places of the samples that do not repeat the one before. Of two samples of one time, values that one of them
    lacks are those of the other. Raises Unusable: times that do not increase."""
    steps = np.diff(t)
    doubtful = np.flatnonzero(steps <= 0.0)
    repeated: set[int] = set()
    moved: list[int] = []
    for i in map(int, doubtful):
        if steps[i] != 0.0:
            continue
        others = {name for name, column in values.items() if not _same(column[i], column[i + 1])}
        for column in values.values():
            one, other = float(column[i]), float(column[i + 1])
            column[i], column[i + 1] = (other if np.isnan(one) else one), (one if np.isnan(other) else other)
        differing = {name for name in others if not _same(values[name][i], values[name][i + 1])}
        if not differing:
            repeated.add(i + 1)
        elif differing & set(_HELD) and not (i > 0 and steps[i - 1] == 0.0):
            moved.append(i)
    few = len(moved) <= max(1.0, MAX_TWICE * len(t))
    left_out = {*repeated, *(moved if few else ())}
    wrong = [int(lines[i + 1]) for i in doubtful if i not in left_out and i + 1 not in left_out]
    if wrong:
        raise Unusable(
            counted(wrong, "the time does not increase", "times do not increase") + _why_not(t, steps, doubtful)
        )
    if repeated:
        lines_left_out = number_of(len(repeated), "line that repeats", "lines that repeat")
        notes.append(f"{lines_left_out} the one before {_were(len(repeated))} left out.")
    for i in moved:
        notes.append(
            f"Line {lines[i]} was left out: line {lines[i + 1]} has the same time, and its values hold from then on."
            + (f" MV before the record is {values['u'][0]:g}." if i == 0 else "")
        )
    return [i for i in range(len(t)) if i not in left_out]


def _why_not(t: Reals, steps: Reals, doubtful: NDArray[np.intp]) -> str:
    """Why times do not increase, and what to do."""
    if len(doubtful) == 1 and _is_hour(float(steps[doubtful[0]]), -_HOUR, float(np.median(steps))):
        return f": the clock went back by an hour there, as at the end of summer time; {_IN_UTC}"
    if any(steps[i] != 0.0 for i in doubtful):
        return ": put the lines into the order of their times, or leave out those that go back"
    why = ": samples of the same time and other values; export fractions of a second, too, or "
    if len(doubtful) < 0.1 * len(t):
        return why + "delete one of them"
    together = len(t) / (len(t) - len(doubtful))
    every = float(t[-1] - t[0]) / max(len(t) - round(together), 1)
    return why + f"give the time between the lines if they come evenly: --every {_round(every):g}s"


def _is_hour(step: float, change: float, usual: float) -> bool:
    """Whether a step between two times is the usual one and the change of a clock by an hour."""
    return abs(step - change - usual) < 0.5 * min(usual, _HOUR)


def _same(a: float, b: float) -> bool:
    return bool(a == b) or (bool(np.isnan(a)) and bool(np.isnan(b)))


def _rows_filled_in(t: Reals, values: Mapping[str, Reals], lines: Whole) -> tuple[Reals, dict[str, Reals]]:
    """The samples with empty ones where a few lines are missing. Raises Unusable: gaps, times that are not even."""
    steps = np.diff(t)
    if not len(steps):
        return t, dict(values)
    usual = float(np.median(steps))
    many = np.rint(steps / usual)
    gaps = np.flatnonzero(many - 1 > MAX_GAP)
    if len(gaps):
        worst = int(gaps[np.argmax(steps[gaps])])
        summer_time = len(gaps) == 1 and _is_hour(float(steps[worst]), _HOUR, usual)
        raise Unusable(
            f"line {lines[worst + 1]}: {steps[worst]:.4g} s after the sample before, where {usual:.4g} s is usual "
            f"({number_of(len(gaps), 'such gap', 'such gaps')}). At most {MAX_GAP} missing samples in a row are "
            "filled: use a part of the file without gaps, or --resample where the historian stores changes alone"
            + (f". If it is the hour that the clock leaves out as summer time begins, {_IN_UTC}" if summer_time else "")
        )
    uneven = np.flatnonzero(np.abs(steps - many * usual) > UNEVEN * usual)
    if len(uneven):
        raise Unusable(
            f"the samples are not evenly spaced within {100 * UNEVEN:.0f} %: line {lines[uneven[0] + 1]} comes "
            f"{steps[uneven[0]]:.4g} s after the sample before, where {usual:.4g} s is usual ({len(uneven)} in all). "
            f"--resample {_round(usual):g}s makes even ones of them"
        )
    if not np.any(steps > GAP * usual):
        return t, dict(values)
    places = np.concatenate([[0], np.cumsum(many)]).astype(int)
    grid = np.interp(np.arange(places[-1] + 1), places, t)
    spread = {}
    for name, column in values.items():
        spread[name] = np.full(len(grid), np.nan)
        spread[name][places] = column
    return grid, spread


def _filled(t: Reals, values: Mapping[str, Reals], notes: list[str]) -> EvenSamples:
    """The samples without those at the ends that lack a value, and with short gaps filled. Raises Unusable."""
    missing = np.any([np.isnan(values[name]) for name in _NEEDED], axis=0)
    there = np.flatnonzero(~missing)
    if not len(there):
        raise Unusable("no sample has values of all columns: MV and PV")
    first, last = int(there[0]), int(there[-1]) + 1
    values = _without_sparse_setpoint({name: column[first:last] for name, column in values.items()}, notes)
    if cut := len(t) - (last - first):
        notes.append(f"{number_of(cut, 'sample', 'samples')} without values at the ends {_were(cut)} left out.")
    t, missing = t[first:last], np.any([np.isnan(column) for column in values.values()], axis=0)
    columns = {name: column.copy() for name, column in values.items()}
    filled = int(np.count_nonzero(missing))
    if not filled:
        return EvenSamples(t, columns, tuple(notes))
    longest, at = _longest_run(missing)
    if longest > MAX_GAP:
        raise Unusable(
            f"{longest} samples in a row have no value, from {t[at]:.6g} s on. At most {MAX_GAP} are filled: use a "
            "part of the file without gaps, or --resample where the historian stores changes alone"
        )
    if filled > MAX_FILLED * len(t):
        raise Unusable(
            f"{filled} of {len(t)} samples have no value; at most {100 * MAX_FILLED:.0f} % are filled: export all, or "
            "use --resample where the historian stores changes alone"
        )
    for name, column in columns.items():
        columns[name] = _interpolated(t, t, column, held=name in _HELD)
    notes.append(
        f"{number_of(filled, 'sample', 'samples')} without a value, at most {longest} in a row, {_were(filled)} "
        "filled: MV and set-point held, PV in a straight line."
    )
    return EvenSamples(t, columns, tuple(notes))


def _without_sparse_setpoint(values: dict[str, Reals], notes: list[str]) -> dict[str, Reals]:
    """The columns without a set-point that lacks more values than are filled: a test in open loop does not need it."""
    if "sp" not in values:
        return values
    missing = np.isnan(values["sp"])
    lacking = int(np.count_nonzero(missing))
    if not lacking or (_longest_run(missing)[0] <= MAX_GAP and lacking <= MAX_FILLED * len(missing)):
        return values
    notes.append(
        f"The set-point was left out: {lacking} of {len(missing)} samples have no value of it, more than are filled."
    )
    return {name: values[name] for name in _NEEDED}


def _without_late_setpoint(t: Reals, values: Mapping[str, Reals], notes: list[str]) -> dict[str, Reals]:
    """The same for samples at uneven times: the set-point holds, but nothing is known of it before its first value."""
    if "sp" not in values:
        return dict(values)
    there = t[~np.isnan(values["sp"])]
    if len(there) > 1 and there[0] - t[0] <= MAX_FILLED * (t[-1] - t[0]):
        return dict(values)
    known = f"has its first of {len(there)} values at {there[0]:.6g} s" if len(there) else "has no value"
    notes.append(f"The set-point was left out: it {known}, the record begins at {t[0]:.6g} s.")
    return {name: values[name] for name in _NEEDED}


def _resampled(t: Reals, values: Mapping[str, Reals], Ts: float, hold: bool | None, notes: list[str]) -> EvenSamples:
    values = _without_late_setpoint(t, values, notes)
    there = {name: t[~np.isnan(column)] for name, column in values.items()}
    if any(len(each) < 2 for each in there.values()):
        raise Unusable("a column has fewer than two values: there is nothing to resample")
    resolution = _resolution_of_changes(t, values["y"])
    held = resolution is not None if hold is None else hold
    start = max(float(each[0]) for each in there.values())
    # of what is not held nothing is known after its last value
    stop = float(t[-1] if held else there["y"][-1])
    if stop <= start:
        raise Unusable(
            f"PV has its last value at {stop:.6g} s, and a column its first one only at {start:.6g} s: there is "
            "nothing to resample; export a time in which all of them have values"
        )
    count = int((stop - start) / Ts + 1e-9) + 1
    if count > MAX_SAMPLES:
        raise Unusable(f"--resample would make {count} samples; at most {MAX_SAMPLES} are possible: ask for fewer")
    grid: Reals = np.asarray(start + Ts * np.arange(count), dtype=np.float64)
    columns = {
        name: _held_means(grid, t, column) if name in _HELD else _interpolated(grid, t, column, held)
        for name, column in values.items()
    }
    times = there["y"]
    longest = float(np.max(np.diff(times)))
    usual = float(np.median(np.diff(times)))
    how = "PV, MV and set-point held" if held else "PV in a straight line, MV and set-point held"
    notes.append(
        f"The samples were made every {Ts:g} s from values of PV every {usual:.3g} s, at most {longest:.3g} s apart: "
        f"{how}. A move of MV is taken as made at the time of the line that "
        "shows it first; the dead time comes out short by as much as the line was late."
    )
    if resolution is not None and hold is None:
        notes.append(
            f"PV changes by {resolution:g} and is not repeated, as where a sensor sends changes alone: it was held. "
            "--no-hold draws straight lines."
        )
    if _is_hour(longest, _HOUR, usual):
        notes.append(f"PV has no value for an hour. If it is the one left out as summer time begins, {_IN_UTC}.")
    if longest > 5.0 * Ts and not held:
        notes.append("Where PV is far between, the record shows straight lines, and the fit knows less than it says.")
    return EvenSamples(grid - grid[0], columns, tuple(notes))


def _resolution_of_changes(t: Reals, column: Reals) -> float | None:
    """The step in which a sensor changes that sends nothing but changes, at uneven times; None for any other column."""
    there = ~np.isnan(column)
    moves, intervals = np.abs(np.diff(column[there])), np.diff(t[there])
    changes = moves[moves > 0.0]
    # a value that did not change for long may be repeated, to show that the sensor lives
    repeated = (moves == 0.0) & (intervals <= np.median(intervals))
    if len(changes) < MIN_CHANGES or np.count_nonzero(repeated) > MAX_REPEATED * len(moves):
        return None
    step = float(np.min(changes))
    steps = changes / step
    even = np.mean(np.abs(intervals - np.median(intervals)) <= UNEVEN * np.median(intervals)) > 0.9
    whole = np.all(np.abs(steps - np.rint(steps)) < 0.01)
    if even or not whole or float(np.mean(steps < 1.5)) < MIN_BY_ONE:
        return None
    return _round(step)


def _held_means(grid: Reals, t: Reals, column: Reals) -> Reals:
    """The means, from each point of an even grid to the next, of a column that holds its value from line to line: a
    move between two points acts on the plant for the rest of the interval."""
    if len(grid) < 2:
        return _interpolated(grid, t, column, held=True)
    edges = np.append(grid, 2.0 * grid[-1] - grid[-2])
    there = ~np.isnan(column)
    times, held = np.append(t[there], max(float(edges[-1]), float(t[-1]))), column[there]
    integral = np.concatenate([[0.0], np.cumsum(held * np.diff(times))])
    means = np.diff(np.interp(edges, times, integral)) / np.diff(edges)
    moves, tolerance = times[1:-1][np.diff(held) != 0.0], 1e-6 * float(edges[1] - edges[0])
    moved = np.searchsorted(moves, edges[1:] - tolerance) > np.searchsorted(moves, edges[:-1] + tolerance)
    # where nothing moves the value itself, which the mean is only to rounding: MV at rest must be at rest
    return np.asarray(np.where(moved, means, _interpolated(grid, t, column, held=True)))


def _interpolated(grid: Reals, t: Reals, column: Reals, held: bool) -> Reals:
    there = ~np.isnan(column)
    if not held:
        return np.asarray(np.interp(grid, t[there], column[there]))
    tolerance = 1e-9 * max(float(t[-1] - t[0]), 1.0)  # of times that are sums of steps
    at = np.searchsorted(t[there], grid + tolerance, side="right") - 1
    return np.asarray(column[there][np.maximum(at, 0)])


def _longest_run(missing: NDArray[np.bool_]) -> tuple[int, int]:
    """The length and the place of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(int), [0]])))
    starts, ends = edges[::2], edges[1::2]
    which = int(np.argmax(ends - starts))
    return int(ends[which] - starts[which]), int(starts[which])


def _round(value: float) -> float:
    return float(f"{value:.2g}")


def _were(count: int) -> str:
    return "was" if count == 1 else "were"
