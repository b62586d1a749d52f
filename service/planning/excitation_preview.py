"""What may move a loop during a retune by fast, in its order, and what each would tell by the model that is known."""

from __future__ import annotations

import math

from pydantic import BaseModel, Field

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest, excitations
from loopwright.service.results import KnowledgeView
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.experiments.step_test import KICK_OF_ROOM
from loopwright.tuning.fast.evaluation.evaluation import MAX_UNCERTAINTY
from loopwright.tuning.fast.experiment import on_trial
from loopwright.tuning.fast.information import Expected, Moved, expected
from loopwright.tuning.fast.pulses.pulse_test import pulse_size
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.relay_test import BIAS, FIRST_AMPLITUDE, max_amplitude
from loopwright.tuning.plan import Mode

_WHEN = {
    Excitation.SETPOINT: "pulses of the set-point under the present gains",
    Excitation.RELAY: "the relay in the controller",
}


class ExcitationPreview(BaseModel):
    """One excitation. The predictions take the model that is known, white noise, and no load."""

    excitation: str = Field(examples=["setpoint"])
    when: str = Field(description="When it moves the loop, in a sentence")
    information_per_pu: float | None = Field(
        description="Predicted information on Ms of the new gains per ultimate period, the reciprocal of the variance; "
        "null: there is no model, no noise_std_hint, or the present gains and MV are not known",
        examples=[940.0],
    )
    Ms_uncertainty: float | None = Field(
        description="Predicted: how far Ms may be off after it, two standard deviations; null likewise", examples=[0.05]
    )
    duration_s: float | None = Field(
        description="Predicted plant time until Ms is known well enough, s, without the step under the new gains that "
        "follows; observe: of that step; null likewise",
        examples=[8.1],
    )


def excitation_previews(
    config: LoopConfig, request: RetuneRequest, state: LoopState | None, known: KnowledgeView | None
) -> list[ExcitationPreview]:
    """The excitations that may follow each other, in their order; empty for other methods than fast.

    config: the configuration with the limits of the job.
    """
    found: list[ExcitationPreview] = []
    moved = None if state is None else _moved(config, state, known)
    for each in excitations(config, request, Mode.AUTOMATIC if state is None else state.mode):
        told: Expected | None = None
        if each is not Excitation.MANUAL and moved is not None and known is not None:
            told = expected(known.model.process_model(), moved, each)
        found.append(
            ExcitationPreview(
                excitation=each.value,
                when=_when(each, bool(found), known),
                information_per_pu=None if told is None else _rounded(told.information_per_period),
                Ms_uncertainty=None if told is None else _rounded(told.uncertainty),
                duration_s=None if told is None else _rounded(told.duration_s),
            )
        )
    return found


def _when(each: Excitation, follows: bool, known: KnowledgeView | None) -> str:
    if each is Excitation.OBSERVE:
        return f"{_of_operation(known)} The history of the loop is looked at again as the job begins."
    if each is Excitation.MANUAL:
        return "Of a loop in manual, and nothing else: pulses of its manual output. The new gains are not tried."
    what = _WHEN[each]
    if not follows:
        return f"First: {what}."
    return f"Only where what comes before tells too little, or shows another plant: {what}."


def _of_operation(known: KnowledgeView | None) -> str:
    if known is None or known.changes is None:
        return "Operation has not shown the plant yet: the loop is moved by the next excitation."
    if known.uncertainty is None:
        return "Operation has shown the plant under other gains: the loop is moved by the next excitation."
    uncertainty = known.proposed.uncertainty if known.proposed else known.uncertainty
    limit = MAX_UNCERTAINTY[Excitation.OBSERVE]
    if uncertainty is None or uncertainty > limit:
        return f"{known.text}: more than {limit:g} for the new gains, so the loop is moved by the next excitation."
    return f"{known.text}: only the step under the new gains moves the loop, unless it shows another plant."


def _moved(config: LoopConfig, state: LoopState, known: KnowledgeView | None) -> Moved | None:
    """How the loop may be moved; None where that is not known, or nothing is to be predicted."""
    if known is None or not config.noise_std_hint:
        return None
    low, high = max(config.mv_limits.low, state.mv_low), min(config.mv_limits.high, state.mv_high)
    jump = config.test.mv_step_max or 2.0 * (high - low)
    room = min(high - state.mv, state.mv - low, 0.5 * jump)
    new = on_trial((known.proposed.gains if known.proposed else known.gains).gains())
    amplitude = FIRST_AMPLITUDE * max_amplitude(state.mv, low, high, jump)
    if not room > 0.0 or not amplitude > 0.0:  # MV may be no number
        return None
    one_sided, kick = config.test.directions != "both", new.b * new.Kp
    step = min(config.sp_deviation, KICK_OF_ROOM * room / kick) if kick > 0.0 else config.sp_deviation
    return Moved(
        gains=state.gains,
        new=new,
        pulse=pulse_size(config.sp_deviation, room, state.gains, one_sided),
        one_sided=one_sided,
        sp_rate_max_per_s=config.test.sp_rate_max_per_s or math.inf,
        step=step,
        high=amplitude,
        low=BIAS * amplitude,
        noise=config.noise_std_hint,
        sample_time_s=state.sample_time_s,
    )


def _rounded(value: float) -> float:
    """Rounds to three digits, which are more than a prediction has."""
    return float(f"{value:.3g}")
