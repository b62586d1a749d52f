"""The words of a report for states, stages, reasons and events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from loopwright.service.api.job_views import JobView
from loopwright.service.api.report.numbers import Ms_error, duration, fixed, significant, with_unit
from loopwright.service.states.job_state import JobState
from loopwright.service.store.jobs import JobEvent
from loopwright.tuning.reasons import Reason

STAGES = {
    "preflight": "Steady-state check",
    "settle": "Settling",
    "pulses": "Set-point pulses",
    "manual": "Manual-output pulses",
    "relay": "Relay test",
    "design": "Model and gains",
    "verify": "Set-point step, new gains",
    "redesign": "Final model",
    "baseline": "Set-point step, previous gains",
    "ultimate": "Ultimate gain",
    "zn_pi": "Ziegler-Nichols PI",
    "estimate": "FOPDT estimate",
    "optimise": "Optimisation",
}
_STRUCTURES = {"fopdt": "first order", "sopdt": "second order"}
REASONS = {
    Reason.OPERATOR: "by an operator",
    Reason.SERVICE_STOPPED: "the service ended",
    Reason.SETPOINT_CHANGED: "set-point changed",
    Reason.SETPOINT_IS_DRIVEN: "set-point is driven by another controller",
    Reason.PV_LIMIT: "PV left its limits",
    Reason.MV_LIMIT: "MV at its limit",
    Reason.NODE_LOST: "node lost",
    Reason.NODE_NOT_ANSWERING: "node does not answer",
    Reason.BUS_LOST: "bus lost",
    Reason.GATEWAY_LOST: "gateway does not answer",
    Reason.INTERNAL: "an error inside the service",
}
_ENDS = {
    JobState.QUEUED: "Queued",
    JobState.RUNNING: "Under test",
    JobState.PROPOSED: "New gains are proposed",
    JobState.ACCEPTED: "Accepted",
    JobState.ROLLED_BACK: "Rolled back to the previous gains",
    JobState.NO_GAIN: "No improvement: the loop is tuned as well as asked",
    JobState.REHEARSED: "Rehearsed: gains found without a test of the loop",
    JobState.REFUSED: "Refused",
    JobState.ABORTED: "Aborted",
    JobState.FAILED: "Failed",
    JobState.INTERRUPTED: "Interrupted",
}
_WITH_REASON = (JobState.REFUSED, JobState.ABORTED, JobState.FAILED, JobState.INTERRUPTED)


def mark_names(stages: Sequence[str]) -> list[str]:
    """Returns the names of the marks in a picture of a record. A step that follows a relay or pulses does not begin at
    rest, and its overshoot in the picture is not that of the gains."""
    names = []
    before = None
    for stage in stages:
        name = stage_name(stage)
        if stage == "verify" and before is not None:
            name = f"Set-point step, from where {before} left PV"
        if stage != "design":
            before = {"relay": "the relay", "pulses": "the pulses"}.get(stage)
        names.append(name)
    return names


def stage_name(stage: str | None) -> str:
    """Returns the name of a stage."""
    return "" if stage is None else STAGES.get(stage, stage.replace("_", " "))


def structure_words(structure: str) -> str:
    """Returns the name of a model structure in words."""
    first, _, rest = structure.partition(" ")
    return " ".join(filter(None, (_STRUCTURES.get(first, first), rest)))


def reason_words(reason: Reason) -> str:
    """Returns a reason in words."""
    return REASONS.get(reason, reason.value.replace("_", " "))


def headline(job: JobView) -> str:
    """Returns how the job ended."""
    text = _ENDS.get(job.state, job.state.value.replace("_", " "))
    if job.state is JobState.PROPOSED and job.superseded_by:
        return f"{text}, not decided; a later job came"
    if job.reason is not None and job.state in _WITH_REASON:
        return f"{text}: {reason_words(job.reason)}"
    return text


def sentence(text: str | None) -> str:
    """Returns a text as a sentence."""
    if not text:
        return ""
    return text[0].upper() + text[1:] + ("" if text[-1] in ".!?" else ".")


def trust(job: JobView) -> list[str]:
    """Returns how far the result is to be trusted, in sentences."""
    said = []
    if job.model_from:
        said.append(f"The model comes from {job.model_from}.")
    if job.verification is not None:
        said.append(f"The model explains {fixed(job.verification.fit_pct, 1)} % of the step that was measured.")
    if job.evidence is not None and job.new_gains is not None:
        Ms = job.predicted.Ms if job.predicted else job.evidence.Ms
        within = job.evidence.uncertainty
        said.append(f"Ms is {fixed(Ms, 2)}" + (f", known to within {Ms_error(within)}." if within is not None else "."))
    if job.tested_on_loop is False:
        said.append("The new gains were never tested on this loop.")
    if job.rehearsed_on is not None:
        said.append(f"Computed on {job.rehearsed_on.plant_text}; the loop was not moved.")
    if job.step_after is not None and job.verification is None:
        settled = f"settled in {duration(job.step_after.settling_s)}" if job.step_after.settled else "not settled"
        overshoot = fixed(job.step_after.overshoot_pct, 0)
        said.append(f"A step under the new gains was measured: overshoot {overshoot} %, {settled}.")
    return said


def stage_found(stage: str, result: Mapping[str, object] | None, pv_unit: str) -> str:
    """Returns what a stage found, in a few words."""
    result = result or {}

    def value(name: str) -> float | None:
        found = result.get(name)
        return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None

    said = []
    if (noise := value("noise")) is not None and stage == "preflight":
        said.append(f"noise {with_unit(significant(noise, 2), pv_unit)}".rstrip())
    if (switches := value("switches")) is not None and stage == "relay":
        said.append(f"{switches:.0f} switches, period {with_unit(significant(value('period_s'), 3), 's')}")
    if (turns := value("turns")) is not None:
        said.append(f"{turns:.0f} turns of the set-point")
    if (Ku_a := value("Ku_a")) is not None:
        said.append(f"Ku about {significant(Ku_a)}, Pu about {with_unit(significant(value('Pu_a_s'), 3), 's')}")
    if (structure := result.get("structure")) is not None:
        said.append(structure_words(str(structure)))
    if (K := value("K")) is not None and (T := value("T_s")) is not None and (L := value("L_s")) is not None:
        said.append(f"K {significant(K)}, T {with_unit(significant(T), 's')}, L {with_unit(significant(L), 's')}")
    if (Ku := value("Ku")) is not None:
        said.append(f"Ku {significant(Ku)}, Pu {with_unit(significant(value('Pu_s')), 's')}")
    if (Ms := value("Ms")) is not None and stage != "verify":
        unsure = value("uncertainty")
        said.append(f"Ms {fixed(Ms, 2)}" + (f" ± {Ms_error(unsure)}" if unsure is not None else ""))
    gains = result.get("gains")
    of = gains if isinstance(gains, dict) else result
    if stage != "verify" and isinstance(Kp := of.get("Kp"), int | float):
        Ti = of.get("Ti", of.get("Ti_s"))
        said.append(f"Kp {significant(Kp)}" + (f", Ti {significant(Ti)} s" if isinstance(Ti, int | float) else ""))
        if isinstance(b := of.get("b"), int | float) and b != 1.0:
            said.append(f"b {significant(b, 3)}")
    if (fit := value("fit_pct")) is not None:
        said.append(f"{fixed(fit, 1)} % of the step explained")
    if (overshoot := value("overshoot_pct")) is not None:
        said.append(f"overshoot {fixed(overshoot, 0)} %")
        if "settling_s" in result:
            settled = value("settling_s")
            said.append("not settled" if settled is None else f"settled in {duration(settled)}")
    reason = result.get("reason")
    if isinstance(reason, str) and reason in set(Reason):
        said.append(f"not enough: {reason_words(Reason(reason))}")
    return ", ".join(said)


def event_words(event: JobEvent) -> tuple[str, str] | None:
    """Returns what happened and by whom, for the events that the record of decisions shows; None for another."""
    data = event.data
    by, text = str(data.get("by", "")), str(data.get("text", data.get("detail", "")))
    if event.kind == "state":
        state = str(data.get("state"))
        what = {
            "queued": "asked for",
            "running": "begun",
            "accepted": "new gains accepted, written to the controller",
            "rolled_back": "previous gains kept or written back",
            "proposed": "ended with a proposal",
        }.get(state, f"ended: {state.replace('_', ' ')}")
        reason = data.get("reason")
        return (f"{what} ({str(reason).replace('_', ' ')})" if reason else what), by
    words = {
        "abort_requested": "abort requested",
        "accept_failed": f"an acceptance ended in an error: {text}",
        "rollback_failed": f"a rollback ended in an error: {text}",
        "resumed": f"resumed after a restart of the service: {text}",
        "loop_found": f"the loop was looked at again: {text}",
        "acknowledged": "responsibility for the loop taken over",
        "samples_deleted": f"samples deleted: {text}",
    }
    return (words[event.kind], by) if event.kind in words else None
