"""The tuning of a model by hand: gains that a controller can realise, their assessment, and a picture of the loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from loopwright.tuning.analysis.assessment import Assessment, assess
from loopwright.tuning.analysis.notebook import as_html
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.fast.known_plant.by_model import BY_MODEL
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import AnyModel, Model, as_model
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.design import realisable
from loopwright.tuning.rules.registry import METHODS as RULES
from loopwright.tuning.rules.registry import Method

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS: dict[str, Method] = {**RULES, BY_MODEL.name: BY_MODEL}
"""Every method for a known model by its name: the rules, and the design of fast."""


@dataclass(frozen=True, slots=True)
class Tuned:
    """The result of a method on a model.

    method, model: the method and the model.
    gains: the ISA gains; an ideal derivative has been given a filter.
    chosen: the design parameters of the rule, by name with unit.
    notes: the notes of the rule and of the filter, one sentence each.
    assessment: the margins and step figures of these gains on this model, with its exact dead time.
    """

    method: Method
    model: Model
    gains: Gains
    chosen: Mapping[str, float]
    notes: tuple[str, ...]
    assessment: Assessment

    def __repr__(self) -> str:
        g, found = self.gains, self.assessment
        derivative = f", Td {g.Td:.4g} s, Tf {g.Tf:.4g} s" if g.Td else ""
        gains = f"{self.method.title}: Kp {g.Kp:.4g}, Ti {g.Ti:.4g} s{derivative}"
        if not found.stable or found.setpoint is None:
            return f"{gains}; the loop would be unstable"
        return f"{gains}; Ms {found.margins.Ms:.3g}, overshoot {found.setpoint.overshoot_pct:.1f} %"

    def plot(self) -> Figure:
        """The picture of PV and MV after a unit set-point step and after a unit load disturbance; needs matplotlib.
        Raises Refused, NOT_ROBUST, for a loop that is not stable."""
        from matplotlib.figure import Figure

        if not self.assessment.stable:
            raise Refused(Reason.NOT_ROBUST, f"{self}: there is no response to draw")
        figure = Figure(figsize=(10, 5), layout="constrained")
        axes = figure.subplots(2, 2, sharex="col")
        for column, of in enumerate(("set-point", "load")):
            response = step_response(self.model, self.gains, load=of == "load")
            axes[0, column].plot(response.t, response.y)
            axes[1, column].plot(response.t, response.u)
            axes[0, column].axhline(1.0 - column, color="black", linewidth=0.8, linestyle=":")
            axes[0, column].set_title(f"unit step of the {of}")
            axes[1, column].set_xlabel("time since the step, s")
        axes[0, 0].set_ylabel("change of PV")
        axes[1, 0].set_ylabel("change of MV")
        figure.suptitle(str(self))
        return figure

    def _repr_html_(self) -> str:
        """What a notebook shows: gains, margins and figures, the notes, and the picture."""
        g, found = self.gains, self.assessment
        figures = [("Kp", f"{g.Kp:.4g}", "MV units per PV unit"), ("Ti", f"{g.Ti:.4g}", "s")]
        if g.Td:
            figures += [("Td", f"{g.Td:.4g}", "s"), ("Tf", f"{g.Tf:.4g}", "s")]
        if found.stable and found.margins.Ms is not None and found.setpoint and found.load:
            figures += [
                ("Ms", f"{found.margins.Ms:.3g}", ""),
                ("overshoot", f"{found.setpoint.overshoot_pct:.3g}", "%"),
                ("IAE, set-point", f"{found.setpoint.IAE:.4g}", "PV units s, unit step"),
                ("IAE, load", f"{found.load.IAE:.4g}", "PV units s, unit step of MV"),
            ]
        return as_html(str(self), [("", "", "unit"), *figures], self.notes, self.plot if found.stable else None)

    def _repr_png_(self) -> bytes | None:
        """The picture that a notebook shows."""
        from io import BytesIO

        if not self.assessment.stable:
            return None
        found = BytesIO()
        self.plot().savefig(found, format="png", dpi=100)
        return found.getvalue()


def method_of(name: str) -> Method:
    """The method of this name in `METHODS`. Raises Refused, BAD_INPUT."""
    if not isinstance(name, str) or name not in METHODS:
        raise Refused(Reason.BAD_INPUT, f"method must be one of {', '.join(METHODS)}, not {name!r}")
    return METHODS[name]


def tune(
    model: AnyModel,
    method: str = "simc",
    dead_time_s: float = 0.0,
    **options: object,
) -> Tuned:
    """The gains that a method gives for a model, with their assessment.

    model: a model of this library, what `identify` has found, a transfer function of another library (control,
    scipy.signal), or a model by names, as `as_model` takes it.
    method, options: a name of `METHODS`, and options of that method. "fast", designed for a maximum sensitivity
    (Ms=1.6), is the design that the procedure `tuning.fast` makes of the model that it has found.
    dead_time_s: the dead time of a transfer function of another library, s.
    Raises Refused: BAD_INPUT (method, option), or as the rule does: NOT_SELF_REGULATING, OUTSIDE_RANGE,
    CANNOT_OSCILLATE. Raises TypeError for what is no model, ValueError for coefficients that make none.
    """
    plant, by = as_model(model, dead_time_s), method_of(method)
    setting = by.tune(plant, **options)
    gains, notes = realisable(setting.gains, by.filter)
    found = assess(plant, gains)
    if not found.stable:
        notes += ("With these gains the loop is unstable on this model.",)
    return Tuned(by, plant, gains, setting.chosen, setting.notes + notes, found)
