"""The design of method fast for a model that is known, as a method beside the rules."""

from __future__ import annotations

from loopwright.tuning.fast.design.design import Aim, DesignSpec, aim_of
from loopwright.tuning.models import Model
from loopwright.tuning.rules.registry import ANY, Method, Option
from loopwright.tuning.rules.setting import Setting


def _by_model(model: Model, *, Ms: float = 1.6, derivative: bool = False, aim: str = Aim.BALANCED) -> Setting:
    from loopwright.tuning.fast.known_plant.design_trial import designed_on  # and with it the whole procedure

    best = designed_on(model, DesignSpec(Ms=Ms, derivative=derivative, aim=aim_of(aim)), 0.0)
    return Setting(best.gains, {"Ms": best.Ms})


BY_MODEL = Method(
    "fast",
    "fast, designed for Ms",
    "docs/fast.md: least IAE under a maximum sensitivity (Astrom, Panagopoulos, Hagglund, Automatica 34, 1998)",
    "Gains as good as the Ms that is asked for permits, for a model that is trusted.",
    "any model",
    ANY,
    _by_model,
    {
        "Ms": Option("", 1.6, "maximum sensitivity that is designed for: 1.2 robust to 2.0 fast", range=(1.2, 2.0)),
        "derivative": Option("", False, "design a PID where a derivative improves the loop", kind="flag"),
        "aim": Option("", str(Aim.BALANCED), "what the gains are the best for", tuple(map(str, Aim)), kind="choice"),
    },
    lag=True,
    slow=True,
)
