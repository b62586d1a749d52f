"""The options that the procedures with a designed controller share."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.design import MAX_WEIGHT, WEIGHTS, Aim, DesignSpec, aim_of
from loopwright.tuning.reasons import Reason, Refused


@dataclass(frozen=True, slots=True)
class DesignOptions:
    """The design specification that is asked for, and what is done with the new gains.

    Ms, derivative, Mt, noise_gain, aim, settling_s, mv_peak: see `tuning.fast.design.DesignSpec`.
    setpoint_weight_max: the largest set-point weight b, see `weights_up_to`.
    verify: the set-point step under the new gains is made.
    propose_anyway: the procedure goes on where the new gains improve nothing that was asked for.
    Raises Refused, BAD_INPUT.
    """

    Ms: float = 1.6
    derivative: bool = False
    Mt: float | None = None
    noise_gain: float | None = None
    verify: bool = True
    propose_anyway: bool = False
    aim: str = Aim.BALANCED
    settling_s: float | None = None
    mv_peak: float | None = None
    setpoint_weight_max: float | None = None

    def spec(self) -> DesignSpec:
        """The design specification of these options. Raises Refused, BAD_INPUT."""
        return DesignSpec(
            self.Ms, self.derivative, self.Mt, self.noise_gain, aim=aim_of(self.aim),
            weights=weights_up_to(self.setpoint_weight_max), settling_s=self.settling_s, mv_peak=self.mv_peak,
        )  # fmt: skip

    def check_sampling(self, facts: Facts) -> None:
        """Raises Refused, BAD_INPUT, for a settling time that no controller of this loop can have: before a test moves
        anything, and whatever the plant is."""
        if self.settling_s is not None and self.settling_s <= facts.sample_time_s:
            raise Refused(
                Reason.BAD_INPUT,
                f"settling_s must be longer than the loop's sample time of {facts.sample_time_s:g} s, not "
                f"{self.settling_s:g} s",
            )

    def __post_init__(self) -> None:
        self.spec()


def weights_up_to(setpoint_weight_max: float | None) -> tuple[float, float]:
    """The range of the set-point weight b up to this largest one, which is at most MAX_WEIGHT; None: that of WEIGHTS.
    Raises Refused, BAD_INPUT."""
    if setpoint_weight_max is None:
        return WEIGHTS
    if not 0.0 <= setpoint_weight_max <= MAX_WEIGHT:
        raise Refused(
            Reason.BAD_INPUT, f"setpoint_weight_max must be from 0 to {MAX_WEIGHT:g}, not {setpoint_weight_max!r}"
        )
    return WEIGHTS[0], setpoint_weight_max
