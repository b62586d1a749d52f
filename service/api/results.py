"""The numbers of a result, as the API shows them."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field


class UltimateView(BaseModel):
    """The ultimate point as measured, or typed in."""

    Ku: float = Field(description="MV percent per PV unit")
    Pu_s: float = Field(description="s")


class ModelView(BaseModel):
    """K exp(-L s)/(T s + 1), or with zeta K exp(-L s)/(T^2 s^2 + 2 zeta T s + 1)."""

    K: float = Field(description="PV units per MV percent")
    T_s: float = Field(description="s; of second order 1/(natural frequency)")
    L_s: float = Field(description="Dead time, s")
    zeta: float | None = Field(default=None, description="Damping ratio of a model of second order")
    k_source: str | None = Field(default=None, description="k5, ke (the estimate), record (identified), typed in")
    k5: float | None = Field(default=None, description="Gain by formula (5)")
    ke: float | None = Field(default=None, description="Gain as measured")
    fit_pct: float | None = Field(default=None, description="Fit of an identified model to its record, NRMSE, percent")


class PredictedView(BaseModel):
    """The new gains on the model."""

    Ms: float
    GM: float | None = Field(description="Ratio; null: no crossing")
    PM_deg: float | None = Field(description="Degrees; null: no crossing")
    overshoot_pct: float
    settling_s: float | None = Field(description="Into 5 %, s; null: not within the response looked at")
    IAE_per_unit: float = Field(description="Of a unit step, s")


class StepView(BaseModel):
    """A set-point step measured on the loop."""

    step: float = Field(description="PV units")
    overshoot_pct: float
    IAE: float = Field(description="PV units * s")
    settling_s: float = Field(description="Into 5 %, s")
    static_gain: float | None = Field(description="PV units per MV percent; null: not known")
    mv_span: float = Field(description="Largest less smallest MV, percent")
    mv_at_limit_s: float = Field(default=0.0, description="How long MV was at the end of its permitted range, s")
    settled: bool
    duration_s: float


def known(kind: type[BaseModel], stored: dict[str, Any] | None) -> Any:
    """The view of a stored result, None when there is none."""
    return kind.model_validate(stored) if stored else None
