"""What a setting is worth on a model: margins, and the figures of a set-point and of a load step."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.tuning.analysis.margins import Margins, margins
from loopwright.tuning.analysis.step_figures import StepFigures
from loopwright.tuning.analysis.step_response import step_figures
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model


@dataclass(frozen=True, slots=True)
class Assessment:
    """setpoint, load: of a unit step of the set-point, and of the plant's input; None when the loop is unstable."""

    margins: Margins
    setpoint: StepFigures | None
    load: StepFigures | None

    @property
    def stable(self) -> bool:
        return self.margins.stable


def assess(model: Model, gains: Gains, band: float = 0.02) -> Assessment:
    """Margins and step figures of these gains on this model, with its exact dead time; Tf = 0 is the ideal derivative.

    band: of settling, a fraction of the final change (load: of the peak). Raises Refused, BAD_INPUT: gains that are
    none, or an ideal derivative on a plant that passes jumps on.
    """
    found = margins(model, gains)
    if not found.stable:
        return Assessment(found, None, None)
    return Assessment(found, step_figures(model, gains, band=band), step_figures(model, gains, load=True, band=band))
