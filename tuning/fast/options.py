"""The options that the procedures with a designed controller share."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design import Aim, DesignSpec, aim_of
from loopwright.tuning.reasons import Reason, Refused


@dataclass(frozen=True, slots=True)
class DesignOptions:
    """The design specification that is asked for, and what is done with the new gains.

    Ms, derivative, Mt, noise_gain, aim, settling_s, mv_peak: see `tuning.fast.design.DesignSpec`.
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

    def spec(self) -> DesignSpec:
        """The design specification of these options. Raises Refused, BAD_INPUT."""
        return DesignSpec(
            self.Ms, self.derivative, self.Mt, self.noise_gain, aim=aim_of(self.aim), settling_s=self.settling_s,
            mv_peak=self.mv_peak,
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
