"""What stages of set-point steps cannot keep where a loop may be moved to one side only, or only by ramps."""

from __future__ import annotations

import math
from collections.abc import Sequence

from loopwright.tuning.experiments.primitives import Directions

TO_BOTH_SIDES = ("relay", "ultimate")
STEPPED = ("baseline", "zn_pi", "verify")


def not_kept(
    directions: Directions, sp_rate_max_per_s: float, stages: Sequence[str], mirrored: bool = False
) -> list[str]:
    """What these stages would break, one sentence each with the way out; empty where they keep to it.

    directions: to which sides the set-point may be moved. sp_rate_max_per_s: its largest rate, PV units per s.
    stages: the stages of the run. mirrored: whether the steps can go down as well.
    """
    both = [stage for stage in TO_BOTH_SIDES if stage in stages]
    stepped = [stage for stage in STEPPED if stage in stages]
    found = []
    if both and directions is not Directions.BOTH:
        found.append(
            f"directions {directions}: PV is moved to both sides of its rest by {' and '.join(both)}; use method "
            "setpoint, or fast with pulses"
        )
    elif stepped and not mirrored and directions is Directions.DOWN:
        found.append(
            f"directions down: the set-point is stepped up by {', '.join(stepped)}; use method setpoint, or fast with "
            "pulses"
        )
    if (stepped or "ultimate" in both) and math.isfinite(sp_rate_max_per_s):
        found.append(
            f"sp_rate_max_per_s {sp_rate_max_per_s:g}: the overshoot and the settling of a step, which a ramp does not "
            f"show, are measured by {', '.join((*both[1:], *stepped))}; use method setpoint, or fast with start=relay"
        )
    return found
