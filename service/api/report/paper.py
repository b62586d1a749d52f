"""The report of a job as one HTML file that needs nothing else: no script, no file, no network."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from loopwright.service.api.job_views import JobView
from loopwright.service.api.report import numbers as n
from loopwright.service.api.report.fingerprint import FIELDS, fingerprint
from loopwright.service.api.report.plots import record_pictures, step_pictures
from loopwright.service.api.report.words import (
    event_words,
    headline,
    sentence,
    stage_found,
    stage_name,
    trust,
)
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jobs.design_curve import DesignCurve
from loopwright.service.jobs.job_record import FITTED, JobRecord
from loopwright.service.planning.curves import LOAD_PCT, LoopCurves, horizons, loop_curves
from loopwright.service.results import GainsView, PerformanceView, StepPerformanceView, TransferModelView
from loopwright.service.states.job_state import JobState
from loopwright.service.store.jobs import JobEvent
from loopwright.service.store.sample_blocks import Block
from loopwright.tuning.analysis.comparison import beside
from loopwright.tuning.fast.evaluation.proposal import delayed
from loopwright.tuning.gains import Gains

if TYPE_CHECKING:
    from jinja2 import Template

_HERE = Path(__file__).parent
STYLE = (_HERE / "report.css").read_text(encoding="utf-8")
_STYLE_HASH = base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()
_IN_FILE = f"default-src 'none'; style-src 'sha256-{_STYLE_HASH}'; img-src data:; base-uri 'none'; form-action 'none'"
POLICY = f"{_IN_FILE}; frame-ancestors 'none'; sandbox"
"""Content-Security-Policy of a report: its own style sheet, and nothing else. The file itself holds what a file can."""
FORM = "u = Kp (b SP − PV + 1/Ti ∫(SP − PV) dt + Td d/dt(c SP − PV) / (1 + Tf s)); Ti 0 is no integral action."
_SHOWN_DESIGNS = 2
"""Every so many designs of the curve are printed."""

Row = tuple[str, str, bool]
"""A name, its value, and whether it takes the whole width."""


@dataclass(frozen=True, slots=True, eq=False)
class ReportSource:
    """All that a report shows.

    loop: the configuration of the loop; None where the loop is no longer configured.
    events: those of the job.  record, designs: None where the job has none.  blocks: the samples.
    version: of the service.  made_at: UTC, ISO 8601.
    not_computed: why record and designs could not be computed.
    """

    job: JobView
    loop: LoopConfig | None
    events: Sequence[JobEvent]
    record: JobRecord | None
    designs: DesignCurve | None
    blocks: Sequence[Block]
    version: str
    made_at: str
    not_computed: str | None = None


def paper(source: ReportSource) -> str:
    """Returns the report as HTML."""
    job, loop = source.job, source.loop
    pv_unit = "PV units" if loop is None else n.unit(loop.pv_unit)
    old, new = job.previous_gains, job.new_gains
    before, after = _performance(source, False), _performance(source, True)
    size = _step_size(source)
    Ms = after.Ms if after is not None else before.Ms if before is not None else None
    old_curves, new_curves = _curves(source)
    unstable = old_curves is None and before is not None and not before.stable
    steps = step_pictures(old_curves, new_curves, size, Ms, unstable)
    record = None if source.record is None else record_pictures(source.record, size)
    decimals = 3 if loop is None else n.pv_decimals(loop.pv_limits.low, loop.pv_limits.high)
    return _template().render(
        job=job,
        policy=_IN_FILE,
        style=STYLE,
        version=source.version,
        made_at=n.date(source.made_at),
        headline=headline(job),
        detail=sentence(job.detail),
        description="" if loop is None else loop.description,
        head=_head(source),
        trust=" ".join(trust(job)),
        verdict=sentence(_verdict(job)),
        decided=f"{_decided(job, source.events)} {_afterwards(job, decimals, pv_unit)}".strip(),
        table=_table(old, new, before, after, job, pv_unit),
        has_before=old is not None,
        has_after=new is not None,
        after_name=_after_name(job),
        form=FORM,
        steps=steps,
        step_text=n.with_unit(n.significant(size, 3), "PV units" if loop is None else loop.pv_unit),
        pv_unit=pv_unit,
        circle=n.fixed(Ms, 2) if Ms is not None else "",
        record=record,
        explained=source.record is not None and source.record.explained is not None,
        noise=source.record is not None and bool(source.record.facts.noise),
        record_note=_record_note(source.record, decimals, pv_unit),
        no_record=_no_record(source),
        model=_model_rows(source, pv_unit),
        designs=_designs(source.designs),
        designed_on="" if source.designs is None else source.designs.designed_on,
        with_td=_with_td(source.designs),
        with_b=_with_b(source.designs),
        with_error=_with_error(source.designs),
        asked=_asked(source),
        stages=[
            (
                stage_name(each.stage),
                each.state,
                stage_found(each.stage, each.result, pv_unit),
                n.duration(each.plant_time_s),
            )
            for each in job.stages
        ],
        notes=[sentence(each) for each in job.notes],
        events=[(n.date(e.at), *told) for e in source.events if (told := event_words(e)) is not None],
        samples=sum(block.count for block in source.blocks),
        hash=fingerprint(job, source.blocks),
        fields=", ".join(FIELDS),
    )


@cache
def _template() -> Template:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # in the process that writes a report alone

    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("report.html")


def _verdict(job: JobView) -> str | None:
    """The comparison in a sentence. That of the job's end speaks of the present gains, which are others after an
    acceptance."""
    if (compared := job.comparison) is None:
        return None
    if job.state in (JobState.ACCEPTED, JobState.ROLLED_BACK) and compared.new.stable:
        return beside(compared.previous, compared.new)
    return compared.verdict


def _gains(view: GainsView | None) -> Gains | None:
    return None if view is None else view.gains()


def _curves(source: ReportSource) -> tuple[LoopCurves | None, LoopCurves | None]:
    """What the gains before and after do: as computed with the designs, else on the job's model."""
    if (designs := source.designs) is not None:
        return designs.previous_curves, designs.new_curves
    job, Ts = source.job, source.job.sample_time_s or 0.0
    if job.model is None:
        return None, None
    model, old, new = delayed(job.model.process_model(), 0.5 * Ts), _gains(job.previous_gains), _gains(job.new_gains)
    ends = horizons(model, (new, old), Ts)
    found = [None if gains is None else loop_curves(model, gains, ends, Ts) for gains in (old, new)]
    return found[0], found[1]


def _performance(source: ReportSource, after: bool) -> PerformanceView | None:
    if (compared := source.job.comparison) is not None:
        return compared.new if after else compared.previous
    if source.designs is None:
        return None
    return source.designs.new if after else source.designs.previous


def _step_size(source: ReportSource) -> float:
    job = source.job
    for measured in (job.verification, job.step_after, job.step_before):
        if measured is not None and measured.step:
            return abs(measured.step)
    return 1.0 if source.loop is None else source.loop.sp_deviation


def _after_name(job: JobView) -> str:
    named = (JobState.PROPOSED, JobState.ACCEPTED, JobState.REHEARSED)
    return "no better" if job.state is JobState.NO_GAIN else job.state.value if job.state in named else "designed"


def _head(source: ReportSource) -> list[Row]:
    job, loop = source.job, source.loop
    rows: list[Row] = []
    if loop is not None:
        where = f"{loop.bus}, node {loop.controller_node} ({loop.controller_node:02X}h), channel {loop.channel}"
        rows += [("area", loop.area, False)] if loop.area else []
        rows += [("controller", where, False)]
    rows += [
        ("job", job.id, False), ("gateway", job.gateway, False),
        ("asked by", job.by, False), ("method", job.method, False),
        ("asked for", f"{n.date(job.created_at)} UTC", False), ("begun", f"{n.date(job.started_at)} UTC", False),
        ("ended", f"{n.date(job.ended_at)} UTC", False), ("plant time", n.duration(job.plant_time_s), False),
    ]  # fmt: skip
    return rows


def _decided(job: JobView, events: Sequence[JobEvent]) -> str:
    if job.decided is not None:
        if job.decided.what == "accept":
            what = "The new gains were accepted"
        elif any(event.kind == "state" and event.data.get("state") == JobState.ACCEPTED for event in events):
            what = "The new gains were accepted first, and the previous ones put back"
        else:
            what = "The previous gains were kept"
        return f"{what} by {job.decided.by}, {n.date(job.decided.at)} UTC."
    if job.superseded_by is not None:
        return f"Nothing was decided before the later test, {job.superseded_by}."
    if job.state is JobState.PROPOSED:
        return "Nothing is decided: the loop runs on its previous gains."
    return ""


def _afterwards(job: JobView, decimals: int, pv_unit: str) -> str:
    """What the loop was when the job gave it back."""
    if job.dry_run or job.started_at is None:
        return ""
    restored = job.restored
    if restored is None:
        return "The loop could not be read back at the end: look at the controller." if job.previous_gains else ""
    text = f"At the end the loop was read back: {restored.get('mode')}"
    if isinstance(sp := restored.get("sp"), int | float):
        text += f", set-point {n.with_unit(n.fixed(sp, decimals), pv_unit)}"
    gains = restored.get("gains")
    if isinstance(gains, dict) and isinstance(Kp := gains.get("Kp"), int | float):
        Ti = gains.get("Ti")
        text += f", Kp {n.significant(Kp)}" + (f", Ti {n.significant(Ti)} s" if isinstance(Ti, int | float) else "")
        if isinstance(b := gains.get("b"), int | float) and b != 1.0:
            text += f", b {n.significant(b, 3)}"
    return text + "."


TableRow = tuple[str, str, str, str, str]
"""A name, its unit, the value before, the value after, and the change."""


def _table(
    old: GainsView | None,
    new: GainsView | None,
    before: PerformanceView | None,
    after: PerformanceView | None,
    job: JobView,
    pv_unit: str,
) -> list[TableRow]:
    if old is None and new is None:
        return []
    rows: list[TableRow] = []

    def row(name: str, of: str, a: float | None, b: float | None, decimals: int | None = None, error: str = "") -> None:
        shown = [n.significant(v) if decimals is None else n.fixed(v, decimals) for v in (a, b)]
        rows.append((name, of, shown[0], shown[1] + error, n.change(a, b)))

    def gain(name: str) -> tuple[float | None, float | None]:
        return (None if old is None else getattr(old, name), None if new is None else getattr(new, name))

    row("Gain Kp", f"%/{pv_unit}", *gain("Kp"))
    row("Integral time Ti", "s", *gain("Ti"))
    for name, of in (("Td", "s"), ("Tf", "s"), ("b", ""), ("c", "")):
        a, b = gain(name)
        usual = 1.0 if name == "b" else 0.0
        if name in ("Td",) or a not in (None, usual) or b not in (None, usual):
            title = {"Td": "Derivative time Td", "Tf": "Derivative filter Tf"}.get(name, f"Set-point weight {name}")
            row(title, of, a, b)
    if before is None and after is None:
        return rows
    if any(each is not None and not each.stable for each in (before, after)):
        rows.append(("Loop on the model", "", _stable(before), _stable(after), ""))

    def figure(name: str) -> tuple[float | None, float | None]:
        return (None if before is None else getattr(before, name), None if after is None else getattr(after, name))

    within = None if job.evidence is None else job.evidence.uncertainty
    row("Ms", "", *figure("Ms"), 2, f" ± {n.Ms_error(within)}" if within is not None and new is not None else "")
    row("Gain margin GM", "", *figure("GM"), 2)
    row("Phase margin PM", "°", *figure("PM_deg"), 0)
    row("Overshoot of a set-point step", "%", *figure("overshoot_pct"), 0)

    def figure_step(name: str, which: str) -> tuple[float | None, float | None]:
        found = [_of_step(each, name, which) for each in (before, after)]
        return found[0], found[1]

    compared = job.comparison
    asked = _at_most(None if compared is None else compared.settling_s_asked)
    row("Settling time (5 %)", f"s{asked}", *figure_step("settling_s", "setpoint"))
    if compared is not None and compared.mv_peak_asked is not None:
        asked = _at_most(compared.mv_peak_asked)
        row("Largest output move", f"% per {pv_unit}{asked}", *figure_step("mv_peak", "setpoint"))
    row("IAE of a unit set-point step", "s", *figure_step("IAE", "setpoint"))
    row(f"IAE of a load step of {LOAD_PCT:g} %", f"{pv_unit} s", *figure_step("IAE", "load"))
    row("Largest deviation after it", pv_unit, *figure_step("peak", "load"))
    if job.step_before is not None or job.step_after is not None:
        measured = (job.step_before, job.step_after)

        def both(name: str) -> tuple[float | None, float | None]:
            found = [None if each is None else getattr(each, name) for each in measured]
            return found[0], found[1]

        row("Overshoot, measured", "%", *both("overshoot_pct"), 0)
        row("Settling time (5 %), measured", "s", *both("settling_s"))
        row("IAE, measured", f"{pv_unit} s", *both("IAE"))
    return rows


def _of_step(performance: PerformanceView | None, name: str, which: str) -> float | None:
    """A figure of the unit step of the set-point, or of a load step as large as the one that is drawn."""
    step = None if performance is None else getattr(performance, which)
    if not isinstance(step, StepPerformanceView):
        return None
    value: float | None = getattr(step, name)
    return value if value is None or which == "setpoint" else LOAD_PCT * value


def _at_most(asked: float | None) -> str:
    return "" if asked is None else f"; asked for: at most {n.significant(asked)}"


def _stable(performance: PerformanceView | None) -> str:
    return n.DASH if performance is None else "stable" if performance.stable else "not stable"


def _record_note(record: JobRecord | None, decimals: int, pv_unit: str) -> str:
    if record is None:
        return ""
    facts = record.facts
    text = f"{facts.recorded} samples, {n.with_unit(n.significant(facts.sample_time_s, 3), 's')} apart."
    if facts.noise:
        text += f" Noise of PV at rest {n.with_unit(n.significant(facts.noise, 2), pv_unit)} (one standard deviation)."
    if facts.model_from == FITTED:
        text += " The model is the one that was fitted to this record, with the disturbances that were found in it."
    elif facts.model_from is not None:
        text += " The model is driven by the MV that was measured; only its level is fitted."
    return text


def _no_record(source: ReportSource) -> str:
    if source.not_computed is not None:
        return f"The record could not be evaluated: {source.not_computed}. GET /jobs/{source.job.id}/samples has it."
    if any(event.kind == "samples_deleted" for event in source.events):
        return "The samples of this job were deleted, as the service was told to."
    return "There is no record: the job ended before its second sample."


_PARAMETERS = {
    "K": "process gain K", "Kv": "velocity gain Kv", "T": "time constant T", "T1": "time constant T1",
    "T2": "time constant T2", "zeta": "damping", "Tz": "zero, time constant Tz", "L": "dead time L",
}  # fmt: skip
"""Names of the parameters of a model; the page has the same."""


def _with_its_unit(text: str, unit: str, pv_unit: str) -> str:
    return n.with_unit(text, unit.replace("PV", n.unit(pv_unit)).replace("MV", "%")) if unit else text


def _model_rows(source: ReportSource, pv_unit: str) -> list[Row]:
    job = source.job
    rows: list[Row] = []
    model = job.model
    if isinstance(model, TransferModelView):
        rows += [
            ("structure", model.named, False),
            *(
                (
                    _PARAMETERS[each.name],
                    _with_its_unit(n.with_error(each.value, each.error), each.unit, pv_unit),
                    False,
                )
                for each in model.parameters
            ),
        ]
        if not model.parameters:
            rows += [
                ("dead time L", n.with_unit(n.with_error(model.dead_time_s, model.dead_time_error_s), "s"), False),
                ("numerator", f"{n.list_with_errors(model.num, model.num_errors)} ({pv_unit}/%)", True),
                ("denominator", n.list_with_errors(model.den, model.den_errors), True),
            ]
    elif model is not None:
        rows.append(("process gain K", f"{n.significant(model.K)} {pv_unit}/%", False))
        rows.append(("time constant T", n.with_unit(n.significant(model.T_s), "s"), False))
        rows.append(("dead time L", n.with_unit(n.significant(model.L_s), "s"), False))
        rows += [("damping", n.significant(model.zeta), False)] if model.zeta is not None else []
        rows += [("fit", f"{n.fixed(model.fit_pct, 1)} %", False)] if model.fit_pct is not None else []
    if job.ultimate is not None:
        ultimate = f"Ku {n.significant(job.ultimate.Ku)} %/{pv_unit}, Pu {n.significant(job.ultimate.Pu_s)} s"
        rows.append(("ultimate point", ultimate, False))
    if (found := job.evidence) is not None:
        unsure = (
            f"± {n.Ms_error(found.uncertainty)} by the model's errors, ± {n.Ms_error(found.ambiguity)} among models"
        )
        rows.append(("Ms is known to", f"{unsure} that explain the record as well", True))
        left = "–" if found.residual is None else f"{n.fixed(found.residual, 2)} times the noise at rest"
        rows.append(("residual", left, False))
        rows.append(("excitation", f"{found.switches} switches or turns, {n.significant(found.period_s, 3)} s", False))
        if (seen := found.longest_delay_seen_s) is not None:
            text = f"would show up to {n.significant(seen, 3)} s later, with 30 % of the effect of MV; not a later one"
            rows.append(("second path", text, True))
        rows += [("drift", "a steady drift of PV was found", False)] if found.drift else []
        for load in found.loads:
            text = f"{load.size:+.3g} % at {n.significant(load.t_s, 3)} s after the excitation began"
            rows.append(("load found", text, True))
    if (on := job.rehearsed_on) is not None:
        rows += [("plant", on.plant_text, True), ("gains", on.gains_text, True)]
    return rows


def _with_td(curve: DesignCurve | None) -> bool:
    return curve is not None and any(each.gains is not None and each.gains.Td > 0.0 for each in curve.designs)


def _with_b(curve: DesignCurve | None) -> bool:
    return curve is not None and any(each.gains is not None and each.gains.b != 1.0 for each in curve.designs)


def _with_error(curve: DesignCurve | None) -> bool:
    return curve is not None and any(each.uncertainty is not None for each in curve.designs)


def _designs(curve: DesignCurve | None) -> list[list[str]]:
    if curve is None:
        return []
    rows = []
    for each in curve.designs[::_SHOWN_DESIGNS]:
        if each.gains is None or each.performance is None:
            continue
        performance = each.performance
        rows.append(
            [
                n.fixed(each.Ms_asked, 2),
                n.significant(each.gains.Kp),
                n.significant(each.gains.Ti),
                *([n.significant(each.gains.Td)] if _with_td(curve) else []),
                *([n.significant(each.gains.b, 3)] if _with_b(curve) else []),
                *([n.Ms_error(each.uncertainty)] if _with_error(curve) else []),
                n.fixed(performance.GM, 2),
                n.fixed(performance.PM_deg, 0),
                n.fixed(performance.overshoot_pct, 0),
                n.significant(performance.setpoint.IAE if performance.setpoint else None, 3),
                n.significant(_of_step(performance, "IAE", "load"), 3),
            ]
        )
    return rows


def _asked(source: ReportSource) -> list[Row]:
    job, loop = source.job, source.loop
    rows: list[Row] = []
    asked = {name: value for name, value in job.request.items() if name not in ("method", "by")}
    given = ", ".join(f"{name} {_value(value)}" for name, value in asked.items() if value not in (None, False, {}, []))
    rows.append(("options", given or "none", True))
    if job.design:
        design = ", ".join(f"{name} {n.significant(value)}" for name, value in job.design.items())
        rows.append(("design", design, True))
    if loop is not None:
        pv, mv = loop.pv_limits, loop.mv_limits
        low = _number(job.request.get("mv_low"), mv.low)
        high = _number(job.request.get("mv_high"), mv.high)
        limits = f"PV {pv.low:g} to {pv.high:g} {n.unit(loop.pv_unit)}, MV {low:g} to {high:g} %"
        rows.append(("limits", limits, True))
    if job.attempts > 1:
        rows.append(("attempts", f"{job.attempts}: the service was restarted meanwhile", False))
    return rows


def _number(value: object, otherwise: float) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else otherwise


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return f"{value:g}"
    if isinstance(value, list | tuple):
        return ", ".join(_value(each) for each in value)
    if isinstance(value, dict):
        return "(" + ", ".join(f"{name} {_value(each)}" for name, each in value.items()) + ")"
    return str(value)
