"""Several methods, or several gains with names, on one model: one table, and a picture of the loops."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from loopwright.tuning.analysis.assessment import assess
from loopwright.tuning.analysis.notebook import as_html
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.fast.known_plant.tuned import METHODS, method_of, tune
from loopwright.tuning.gains import AnyGains, Gains, as_gains
from loopwright.tuning.models import AnyModel, Model, as_model
from loopwright.tuning.reasons import Ended

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEAD = ("", "Kp", "Ti", "Td", "b", "Ms", "GM", "PM", "delay margin", "overshoot", "settling", "IAE SP", "IAE load")
UNITS = ("", "MV/PV", "s", "s", "", "", "", "deg", "s", "%", "s", "s", "s")


@dataclass(frozen=True, slots=True)
class ComparedGains:
    """One row of a comparison; the figures of a loop that is not stable are None, and so is all of a method that
    refused.

    name: the name of the row.
    Kp, Ti, Td, Tf, b, c: the gains, see `Gains`.
    Ms, GM, PM_deg, delay_margin_s: the margins, see `Margins`.
    overshoot_pct, settling_s: after a set-point step, percent, and s until PV stays within 2 %.
    IAE_setpoint, IAE_load: the IAE of a unit step of the set-point and of the load at the plant's input, PV units s.
    note: why there are no gains or no figures, in a sentence; "" where there are.
    """

    name: str
    Kp: float | None = None
    Ti: float | None = None
    Td: float | None = None
    Tf: float | None = None
    b: float | None = None
    c: float | None = None
    Ms: float | None = None
    GM: float | None = None
    PM_deg: float | None = None
    delay_margin_s: float | None = None
    overshoot_pct: float | None = None
    settling_s: float | None = None
    IAE_setpoint: float | None = None
    IAE_load: float | None = None
    note: str = ""

    @property
    def gains(self) -> Gains | None:
        """The gains of the row; None of a method that refused."""
        if self.Kp is None or self.Ti is None or self.Td is None or self.Tf is None or self.b is None or self.c is None:
            return None
        return Gains(self.Kp, self.Ti, self.Td, self.Tf, self.b, self.c)


@dataclass(frozen=True, slots=True, repr=False)
class MethodComparison:
    """The comparison of several gains on one model. `pandas.DataFrame(compared.rows)` is the same as a data frame.

    model: the model.
    rows: a row for each of the gains, in the order given.
    """

    model: Model
    rows: tuple[ComparedGains, ...]

    def __getitem__(self, name: str) -> ComparedGains:
        """The row of this name. Raises KeyError."""
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(f"{name}: there are {', '.join(row.name for row in self.rows)}")

    def __repr__(self) -> str:
        """The table as text."""
        table = [HEAD, UNITS, *map(_cells, self.rows)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = [
            "  ".join(cell.rjust(width) if i else cell.ljust(width) for i, (cell, width) in enumerate(each)).rstrip()
            for each in (zip(row, widths, strict=True) for row in table)
        ]
        return "\n".join([f"{self.model!r}", *lines, *self._notes()])

    def _repr_html_(self) -> str:
        """What a notebook shows: the table, why rows have no figures, and the picture."""
        stable = any(row.Ms is not None for row in self.rows)
        table = [HEAD, UNITS, *map(_cells, self.rows)]
        return as_html(repr(self.model), table, self._notes(), self.plot if stable else None)

    def plot(self) -> Figure:
        """The picture of PV of all stable loops after a unit step of the set-point and of the load; needs
        matplotlib."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10, 4), layout="constrained")
        shown = [(row.name, row.gains) for row in self.rows if row.gains is not None and row.Ms is not None]
        for axes, load in zip(figure.subplots(1, 2), (False, True), strict=True):
            responses = {name: step_response(self.model, gains, load=load) for name, gains in shown}
            for name, response in responses.items():
                axes.plot(response.t, response.y, label=name)
            # one slow loop must not squeeze the others
            ends = sorted(float(response.t[-1]) for response in responses.values())
            if ends:
                axes.set_xlim(0.0, ends[len(ends) // 2])
            axes.set(title=f"unit step of the {'load' if load else 'set-point'}", xlabel="s", ylabel="change of PV")
        if shown:
            axes.legend()
        return figure

    def _notes(self) -> list[str]:
        return [f"{row.name}: {row.note}" for row in self.rows if row.note]


def compare(
    model: AnyModel, given: Iterable[str] | Mapping[str, str | AnyGains] | None = None, dead_time_s: float = 0.0
) -> MethodComparison:
    """Compares methods, or gains with names, on one model.

    model, dead_time_s: as of `tune`.
    given: names of `METHODS`; or by names of your own the name of a method, gains, or a result that has gains, such as
    {"present": Gains(2.0, 10.0), "robust": tune(model, "fast", Ms=1.3), "simc": "simc"}. By default every method.
    Gains are judged on this model, wherever they come from. A method that refuses the model has a row with the reason.
    Raises Refused, BAD_INPUT: no such method, or gains out of range. Raises TypeError and ValueError as `tune`, and
    TypeError for what are neither names nor gains.
    """
    plant = as_model(model, dead_time_s)
    if given is None:
        given = METHODS
    if isinstance(given, str) or not isinstance(given, Iterable):
        example = '["simc", "fast"], or {"present": Gains(Kp=..., Ti=...)}'
        raise TypeError(f"give the methods or gains to compare as a list or a dictionary, {example}, not {given!r}")
    named = given if isinstance(given, Mapping) and given is not METHODS else {name: name for name in given}
    for each in named.values():
        if isinstance(each, str):
            method_of(each)
        else:
            as_gains(each)
    return MethodComparison(plant, tuple(_row(str(name), plant, each) for name, each in named.items()))


def _row(name: str, model: Model, given: str | AnyGains) -> ComparedGains:
    if isinstance(given, str):
        try:
            tuned = tune(model, given)
        except Ended as refused:
            return ComparedGains(name, note=f"{refused.reason.value}: {refused.detail}")
        gains, found = tuned.gains, tuned.assessment
    else:
        gains = as_gains(given)
        found = assess(model, gains)
    numbers = (gains.Kp, gains.Ti, gains.Td, gains.Tf, gains.b, gains.c)
    m, setpoint, load = found.margins, found.setpoint, found.load
    if setpoint is None or load is None:
        return ComparedGains(name, *numbers, note="the loop would be unstable")
    return ComparedGains(
        name, *numbers, m.Ms, m.GM, m.PM_deg, m.delay_margin_s,
        setpoint.overshoot_pct, setpoint.settling_s, setpoint.IAE, load.IAE,
    )  # fmt: skip


def _cells(row: ComparedGains) -> tuple[str, ...]:
    numbers = (
        row.Kp, row.Ti, row.Td, row.b, row.Ms, row.GM, row.PM_deg, row.delay_margin_s,
        row.overshoot_pct, row.settling_s, row.IAE_setpoint, row.IAE_load,
    )  # fmt: skip
    return (row.name, *("-" if value is None else f"{value:.3g}" for value in numbers))
