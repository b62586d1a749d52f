"""What explains a record as well as load disturbances do: a second path, or a gain that changes with MV."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.score_tests.changing_gain import find_changing_gain
from loopwright.tuning.fast.score_tests.second_path import find_second_path
from loopwright.tuning.identification.output_error import Fit, Fitted


@dataclass(frozen=True, slots=True)
class Instead:
    """What explains a record in place of load disturbances.

    what: in words.
    bic_gain, rms: see `WithoutLoads`.
    changing: whether it is a gain that changes with MV.
    plausible: whether its size is one that the words of a refusal may name.
    """

    what: str
    bic_gain: float
    rms: float
    changing: bool
    plausible: bool


def rival_explanations(fit: Fit[ExperimentRecord], best: Fitted) -> Instead | None:
    """What explains the record best in place of the load disturbances of the best model; None where the model has none,
    or where what is found is too small to matter for Ms."""
    found = [each for each in (_second_path(fit, best), _changing_gain(fit, best)) if each is not None]
    return max(found, key=lambda each: each.bic_gain, default=None)


def _second_path(fit: Fit[ExperimentRecord], best: Fitted) -> Instead | None:
    second = find_second_path(fit, best)
    if second is None:
        return None
    part = f"{100.0 * second.share:.0f} %" if second.share < 1.0 else "most"
    what = f"{part} of MV's effect came {second.later_s:.3g} s later than the rest"
    return Instead(what, second.bic_gain, second.rms, changing=False, plausible=second.share < 1.0)


def _changing_gain(fit: Fit[ExperimentRecord], best: Fitted) -> Instead | None:
    changing = find_changing_gain(fit, best)
    if changing is None:
        return None
    return Instead(changing.what, changing.bic_gain, changing.rms, changing=True, plausible=True)
