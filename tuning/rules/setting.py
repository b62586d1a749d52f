"""What a tuning rule answers with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from loopwright.tuning.gains import Gains


@dataclass(frozen=True, slots=True)
class Setting:
    """gains: ISA form, Kp positive.  chosen: the design parameters in effect (lambda_s, tau_c_s, ...), by name with
    unit.  notes: what the user should know (a guideline left, an approximation taken), one sentence each.
    """

    gains: Gains
    chosen: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
