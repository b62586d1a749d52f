"""The assessment of gains on a model: margins, and the figures of a set-point step and of a load disturbance."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.tuning.analysis.margins import Margins, margins
from loopwright.tuning.analysis.step_figures import StepFigures
from loopwright.tuning.analysis.step_response import step_figures
from loopwright.tuning.gains import AnyGains, as_gains
from loopwright.tuning.models import AnyModel, as_model


@dataclass(frozen=True, slots=True)
class Assessment:
    """The assessment of one set of gains on one model.

    margins: the stability margins.
    setpoint: the figures of a unit set-point step, None when the loop is unstable.
    load: the figures of a unit load disturbance at the plant's input, None when the loop is unstable.
    """

    margins: Margins
    setpoint: StepFigures | None
    load: StepFigures | None

    @property
    def stable(self) -> bool:
        return self.margins.stable


def assess(model: AnyModel, gains: AnyGains, band: float = 0.02) -> Assessment:
    """The margins and step figures of these gains on this model, with its exact dead time.

    gains: the gains; Tf = 0 is the ideal derivative.
    band: the settling band, as a fraction of the final change (after a load disturbance: of the peak).
    Raises Refused, BAD_INPUT: gains out of range, or an ideal derivative on a plant with feed-through. Raises TypeError
    for what is no model or has no gains.
    """
    plant, in_effect = as_model(model), as_gains(gains)
    found = margins(plant, in_effect)
    if not found.stable:
        return Assessment(found, None, None)
    return Assessment(
        found, step_figures(plant, in_effect, band=band), step_figures(plant, in_effect, load=True, band=band)
    )
