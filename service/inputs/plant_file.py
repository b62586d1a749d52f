"""What a rehearsal has to know of a loop: a plant file, or what goes with a plant of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from loopwright.service.inputs.model_json import named, parse_model
from loopwright.service.inputs.plausible import Finite, Gain, Size, Time, TimeOrNone, Value, check_model
from loopwright.tuning.experiments.primitives import Directions
from loopwright.tuning.gains import Gains


class PresentGains(BaseModel):
    """The gains of the loop before the test, in ISA form."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    Kp: Gain
    Ti: TimeOrNone = Field(default=0.0, description="s; 0: no integral part")
    Td: TimeOrNone = Field(default=0.0, description="s")
    Tf: TimeOrNone = Field(default=0.0, description="s, filter of the derivative")
    b: Finite = Field(default=1.0, description="set-point weight of the proportional path")
    c: Finite = Field(default=0.0, description="set-point weight of the derivative path")


def _as_mapping(gains: object) -> object:
    return asdict(gains) if isinstance(gains, Gains) else gains


class RehearsedPlant(BaseModel):
    """What a rehearsal has to know of a loop besides its plant; what is left out is chosen and echoed."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    name: str = "plant"
    sample_time_s: Time | None = None
    t95_s: Time | None = None
    mv_limits: tuple[Value, Value]
    mv_step_max: Annotated[Value, Field(gt=0)] | None = Field(None, description="largest jump of MV in the test")
    directions: Directions = Field(Directions.BOTH, description="to which sides of its rest the set-point is moved")
    sp_rate_max_per_s: Annotated[Value, Field(gt=0)] | None = Field(
        None, description="largest rate of the set-point in the test, PV units per s"
    )
    sp_deviation: Annotated[Value, Field(gt=0)] | None = None
    gains: Annotated[PresentGains, BeforeValidator(_as_mapping)] | None = Field(
        None, description="present gains of the loop"
    )
    reverse_acting: bool | None = Field(None, description="the controller's action; left out: right for the plant")


class PlantFile(RehearsedPlant):
    """A plant for `loopwright rehearse`, in deviation variables; what is left out is chosen and echoed."""

    num: list[float] = Field(min_length=1, max_length=12, description="numerator, highest power of s first")
    den: list[float] = Field(min_length=1, max_length=12, description="denominator, highest power of s first")
    dead_time_s: float = Field(0.0, ge=0)
    noise_std: Size = Field(0.0, description="standard deviation of the measurement, PV units")
    seed: int = Field(1, ge=0)
    mv_limits: tuple[Value, Value] = (-0.5, 0.5)

    @model_validator(mode="before")
    @classmethod
    def _any_form(cls, data: object) -> object:
        """Takes a model in any form, such as K, T_s, L_s, in place of num, den and dead_time_s."""
        if isinstance(data, str):
            data = named(data)
        if not isinstance(data, Mapping) or "num" in data or "den" in data:
            return data
        form = {name: value for name, value in data.items() if name not in cls.model_fields}
        if not form:
            return data
        model = parse_model(form)
        polynomials = {"num": list(model.num), "den": list(model.den), "dead_time_s": model.L}
        return {name: value for name, value in data.items() if name not in form} | polynomials

    @model_validator(mode="after")
    def _proper(self) -> PlantFile:
        if not any(self.den) or self.den[0] == 0:
            raise ValueError("den must start with a coefficient other than 0")
        if len(self.num) > len(self.den):
            raise ValueError(f"num has order {len(self.num) - 1}, more than den's {len(self.den) - 1}: not proper")
        if not any(self.num):
            raise ValueError("num is zero: the plant does not answer MV")
        if self.num[-1] == 0 and self.den[-1] != 0:
            raise ValueError("num must end with a coefficient other than 0: PV would come back from every move of MV")
        if not self.mv_limits[0] < 0 < self.mv_limits[1]:
            raise ValueError(f"mv_limits must be [low < 0, high > 0] around the operating point, not {self.mv_limits}")
        check_model(self.num, self.den, self.dead_time_s)
        return self


class OwnPlant(RehearsedPlant):
    """A plant of one's own, an object with step(mv), in absolute values."""

    name: str = "own plant"
    mv_limits: tuple[Value, Value] = (0.0, 100.0)
    pv_limits: tuple[Value, Value] | None = Field(None, description="PV at which the test ends, PV units")
    mv: Value | None = Field(None, description="MV at rest; left out: in the middle of its limits")
    pv: Value | None = Field(None, description="PV at rest; left out: where PV comes to while MV is held")

    @model_validator(mode="after")
    def _complete(self) -> OwnPlant:
        for name in ("sample_time_s", "t95_s"):
            if getattr(self, name) is None:
                raise ValueError(f"{name} is missing: {_MEANING[name]}")
        low, high = self.mv_limits
        if not low < high:
            raise ValueError(f"mv_limits must be [low, high], not {list(self.mv_limits)}")
        if not low < self.mv_at_rest < high:
            raise ValueError(f"mv must be between its limits {low:g} and {high:g}, not {self.mv:g}")
        return self

    @property
    def mv_at_rest(self) -> float:
        """MV at rest, MV units."""
        return 0.5 * sum(self.mv_limits) if self.mv is None else self.mv


_MEANING = {
    "sample_time_s": "the time that one step(mv) of the plant takes, s",
    "t95_s": "about the time in which PV covers 95 % of its answer to a step of MV, s",
}
