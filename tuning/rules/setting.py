"""The setting that a tuning rule gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from loopwright.tuning.gains import Gains


@dataclass(frozen=True, slots=True)
class Setting:
    """The gains of a rule, with the design parameters behind them.

    gains: the ISA gains, Kp positive.
    chosen: the design parameters in effect (lambda_s, tau_c_s, ...), by name with unit.
    notes: what the user should know (a guideline exceeded, an approximation made), one sentence each.
    """

    gains: Gains
    chosen: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
