"""Plots as the numbers of an SVG: paths, ticks and labels. The template makes the markup."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from loopwright.service.api.report.numbers import fixed
from loopwright.tuning.models import Reals

LEFT, RIGHT, TOP, BOTTOM = 52.0, 8.0, 8.0, 20.0
_TICK_APART = 70.0
_FARTHEST = 1e5
_NAME_WIDTH, _PER_LETTER = 130.0, 5.5
"""Width that the name of a line may take, px: at least, and for each letter."""
Place = TypeVar("Place", float, Reals)


@dataclass(frozen=True, slots=True)
class Tick:
    """A tick. at: its place in the picture, px."""

    at: float
    label: str


@dataclass(frozen=True, slots=True)
class Path:
    """A curve: the attribute d of a path, and the name of its look in the style sheet."""

    d: str
    look: str


@dataclass(frozen=True, slots=True)
class Label:
    """A text in the picture, at x and y in px."""

    x: float
    y: float
    text: str
    look: str = "note"


@dataclass(slots=True)
class Picture:
    """A plot with linear axes.

    name: what it shows, for those who do not see it.  x, y: the ranges of the axes.  width, height: px.
    named_x, named_y: whether the ticks of the axis have labels.
    """

    key: str
    name: str
    x: tuple[float, float]
    y: tuple[float, float]
    width: float
    height: float
    named_x: bool = True
    x_apart: float = _TICK_APART
    y_apart: float = 28.0
    paths: list[Path] = field(default_factory=list)
    bands: list[tuple[float, float]] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)

    @property
    def left(self) -> float:
        return LEFT

    @property
    def top(self) -> float:
        return TOP

    @property
    def inner_width(self) -> float:
        return self.width - LEFT - RIGHT

    @property
    def inner_height(self) -> float:
        return self.height - TOP - (BOTTOM if self.named_x else 4.0)

    def at_x(self, x: Place) -> Place:
        """Returns the place of a value, px."""
        return LEFT + self.inner_width * (x - self.x[0]) / (self.x[1] - self.x[0])

    def at_y(self, y: Place) -> Place:
        """Returns the place of a value, px."""
        return TOP + self.inner_height * (self.y[1] - y) / (self.y[1] - self.y[0])

    def curve(self, x: Sequence[float] | Reals, y: Sequence[float] | Reals, look: str, stepped: bool = False) -> None:
        """Adds a curve; a value that is no number interrupts it."""
        parts: list[str] = []
        last: float | None = None
        for px, py in zip(self.at_x(np.asarray(x, float)), self.at_y(np.asarray(y, float)), strict=True):
            if not (math.isfinite(py) and abs(py) < _FARTHEST and abs(px) < _FARTHEST):
                last = None
            elif last is None:
                parts.append(f"M{px:.1f} {py:.1f}")
                last = py
            else:
                parts.append(f"H{px:.1f}V{py:.1f}" if stepped else f"L{px:.1f} {py:.1f}")
                last = py
        if parts:
            self.paths.append(Path("".join(parts), look))

    def line_at(self, x: float, look: str, text: str = "", row: int = 0) -> None:
        """Adds an upright line, with its name beside it."""
        px = self.at_x(x)
        self.paths.append(Path(f"M{px:.1f} {TOP:.1f}V{TOP + self.inner_height:.1f}", look))
        if text:
            at_the_end = px > LEFT + self.inner_width - max(_NAME_WIDTH, _PER_LETTER * len(text))
            place = px - 3.0 if at_the_end else px + 3.0
            self.labels.append(Label(place, TOP + 10.0 + 11.0 * row, text, "end" if at_the_end else "note"))

    def band(self, low: float, high: float) -> None:
        """Adds a band of y."""
        top, bottom = (min(max(self.at_y(each), TOP), TOP + self.inner_height) for each in (high, low))
        self.bands.append((top, bottom - top))

    @property
    def x_ticks(self) -> list[Tick]:
        """The ticks of the x axis."""
        return [Tick(self.at_x(v), t) for v, t in ticks(*self.x, max(2.0, self.inner_width / self.x_apart))]

    @property
    def y_ticks(self) -> list[Tick]:
        """The ticks of the y axis."""
        return [Tick(self.at_y(v), t) for v, t in ticks(*self.y, max(2.0, self.inner_height / self.y_apart))]


def ticks(low: float, high: float, number: float) -> list[tuple[float, str]]:
    """Returns ticks that are 1, 2 or 5 apart, at most about so many, with the decimals that their distance needs."""
    raw = (high - low) / number
    power = 10.0 ** math.floor(math.log10(raw))
    distance = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if raw <= m * power * (1.0 + 1e-9))
    decimals = max(0, -math.floor(math.log10(distance) + 1e-9))
    first, last = math.ceil(low / distance - 1e-9), math.floor(high / distance + 1e-9)
    return [(n * distance, fixed(n * distance, decimals)) for n in range(first, last + 1)]


def around(columns: Iterable[Reals], smallest: float, share: float = 0.06) -> tuple[float, float]:
    """Returns a range around all values, never narrower than `smallest`."""
    values = np.concatenate([np.asarray(column, float).ravel() for column in columns])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, smallest)
    smallest = max(smallest, 1e-9 * max(abs(low), abs(high)), 1e-12)
    if high - low < smallest:
        middle = 0.5 * (low + high)
        low, high = middle - 0.5 * smallest, middle + 0.5 * smallest
    room = share * (high - low)
    return low - room, high + room
