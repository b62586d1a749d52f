"""Which of several tunings of one model to take first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from loopwright.tuning.analysis.assessment import Assessment

MAX_MS = 1.7
"""Largest Ms of a method that is recommended: the gain may be 2.4 times as large as the model's before the loop is
unstable, which allows for the model as well as for the plant."""


@dataclass(frozen=True, slots=True)
class Recommendation:
    """The method to take first, and why."""

    method: str
    reason: str


def recommended(assessed: Mapping[str, Assessment]) -> Recommendation | None:
    """Returns the method with the lowest IAE of set-point and load among those with an Ms of at most 1.7.

    Either IAE counts in relation to the lowest among these methods.

    assessed: the assessment of the gains of each method that gave some, by its name.
    None: fewer than two methods gave gains, or none of them is as robust.
    """
    order = ranked(assessed)
    if len(assessed) < 2 or not order:
        return None
    figures = _figures(assessed[order[0]])
    assert figures is not None
    setpoint, load, Ms = figures
    return Recommendation(
        order[0],
        f"of the {len(order)} methods with Ms at most {MAX_MS:g} it has the lowest IAE of set-point "
        f"({setpoint:.3g}) and load ({load:.3g}) together; Ms {Ms:.2f}",
    )


def ranked(assessed: Mapping[str, Assessment]) -> list[str]:
    """Returns the methods with an Ms of at most 1.7, that with the lowest IAE of set-point and load first."""
    robust = {name: figures for name, each in assessed.items() if (figures := _figures(each)) is not None}
    if not robust:
        return []
    least = [min(figures[i] for figures in robust.values()) for i in (0, 1)]
    return sorted(robust, key=lambda name: robust[name][0] / least[0] + robust[name][1] / least[1])


def _figures(assessed: Assessment) -> tuple[float, float, float] | None:
    """The IAE of set-point and load, and Ms; None where there are none or the gains are less robust."""
    if assessed.setpoint is None or assessed.load is None or assessed.margins.Ms is None:
        return None
    if assessed.margins.Ms > MAX_MS:
        return None
    return assessed.setpoint.IAE, assessed.load.IAE, assessed.margins.Ms
