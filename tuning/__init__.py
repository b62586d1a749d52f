"""Control mathematics for PI and PID loops: models, rules, margins, responses, identification, procedures.

    from loopwright import tuning

    plant = tuning.FOPDT(K=2.0, T=10.0, L=1.0)
    found = tuning.tune(plant, "simc")
    print(found)                                    # gains, Ms, overshoot
    found.plot().savefig("simc.png")                # a notebook shows it by itself

Models        FOPDT, SOPDT, Integrating, TransferFunction, as_model (from control, scipy.signal, or names: {"K": ...});
              what takes a model takes all of these, and results with a model (of identify, observe, tune)
Tuning        tune (by a rule, or as the procedure fast designs: "fast", Ms=1.6), compare (methods, or gains with
              names, in one table), METHODS (every method: what it is for, its source, its options), Tuned, Gains;
              what takes gains takes results with gains
Analysis      margins (Ms, gain, phase and delay margin), bode, nyquist, ultimate_point, assess, step_response,
              step_figures
Reduction     half_rule, moments, two_areas
From a record identify (a test), observe (a loop in automatic: model and gains), fopdt_from_overshoot
Other forms   to_parallel, of_parallel, to_series, of_series
Errors        Refused (with a Reason, and what to do about it)

Times are in s, gains in ISA form: u = Kp (b SP - PV + integral(SP - PV)/Ti + Td d/dt(c SP - PV)/(1 + Tf s)).
The library is pure: no clock, no input or output. The procedures that tune live loops are `tuning.fast` and
`tuning.five_stage`. Its matrices are small, and the threads of BLAS make it slower, tens of times on a busy machine:
set OPENBLAS_NUM_THREADS=1 in the environment before numpy is imported.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loopwright.tuning.analysis.assessment import Assessment, assess
    from loopwright.tuning.analysis.frequency_response import Bode, Nyquist, bode, nyquist
    from loopwright.tuning.analysis.margins import Margins, margins, ultimate_point
    from loopwright.tuning.analysis.step_figures import StepFigures
    from loopwright.tuning.analysis.step_response import Response, step_figures, step_response
    from loopwright.tuning.fast.known_plant.method_comparison import ComparedGains, MethodComparison, compare
    from loopwright.tuning.fast.known_plant.tuned import METHODS, Tuned, tune
    from loopwright.tuning.gains import Gains, Parallel, Series, of_parallel, of_series, to_parallel, to_series
    from loopwright.tuning.identification.identify import Identified, identify
    from loopwright.tuning.identification.overshoot import fopdt_from_overshoot
    from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction, as_model
    from loopwright.tuning.operation.recorded_operation import Observed, observe
    from loopwright.tuning.reasons import Reason, Refused
    from loopwright.tuning.reduction.half_rule import half_rule
    from loopwright.tuning.reduction.moments_and_areas import moments, two_areas
    from loopwright.tuning.rules.registry import Method

_WHERE = {
    "analysis.assessment": ("Assessment", "assess"),
    "analysis.frequency_response": ("Bode", "Nyquist", "bode", "nyquist"),
    "analysis.margins": ("Margins", "margins", "ultimate_point"),
    "analysis.step_figures": ("StepFigures",),
    "analysis.step_response": ("Response", "step_figures", "step_response"),
    "gains": ("Gains", "Parallel", "Series", "of_parallel", "of_series", "to_parallel", "to_series"),
    "identification.identify": ("Identified", "identify"),
    "identification.overshoot": ("fopdt_from_overshoot",),
    "models": ("FOPDT", "SOPDT", "Integrating", "Model", "TransferFunction", "as_model"),
    "reasons": ("Reason", "Refused"),
    "reduction.half_rule": ("half_rule",),
    "reduction.moments_and_areas": ("moments", "two_areas"),
    "rules.registry": ("Method",),
    "fast.known_plant.method_comparison": ("MethodComparison", "ComparedGains", "compare"),
    "operation.recorded_operation": ("Observed", "observe"),
    "fast.known_plant.tuned": ("METHODS", "Tuned", "tune"),
}
_HOME = {name: module for module, names in _WHERE.items() for name in names}

__all__ = [
    "FOPDT", "METHODS", "SOPDT", "Assessment", "Bode", "ComparedGains", "Gains", "Identified", "Integrating",
    "Margins", "Method", "MethodComparison", "Model", "Nyquist", "Observed", "Parallel", "Reason", "Refused",
    "Response", "Series", "StepFigures", "TransferFunction", "Tuned", "as_model", "assess", "bode", "compare",
    "fopdt_from_overshoot", "half_rule", "identify", "margins", "moments", "nyquist", "observe", "of_parallel",
    "of_series", "step_figures", "step_response", "to_parallel", "to_series", "tune", "two_areas", "ultimate_point",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Loads a name when it is first used, so that the import of a model does not import every rule."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
