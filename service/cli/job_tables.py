"""Shows jobs and loops on a terminal."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from datetime import datetime
from math import inf
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from loopwright.service.api.job_views import JobView, LockView, LoopDetail
from loopwright.service.api.report.words import stage_found, stage_name
from loopwright.service.cli.answers import NoteEvent, ProgressEvent, StageDoneEvent, StateEvent, job_event
from loopwright.service.cli.client import Client
from loopwright.service.results import (
    ComparisonView,
    EvidenceView,
    GainsView,
    ModelView,
    PredictedView,
    StepView,
    TransferModelView,
    UltimateView,
    VerificationView,
)
from loopwright.service.states.job_state import JobState

if TYPE_CHECKING:
    from loopwright.service.execution.rehearsal import Rehearsal

console = Console()
progress_console = Console(stderr=True)
_MARGINS = (("GM", "GM", ""), ("PM", "PM_deg", "deg"), ("Ms", "Ms", ""))
_PREDICTED = (
    ("overshoot", "overshoot_pct", "%"),
    ("settling", "settling_s", "s"),
    ("IAE, unit step", "IAE_per_unit", "s"),
    *_MARGINS,
)
"""Figures of a job of an earlier version, which has no comparison."""
_NOTHING = ("", "-")


def follow(client: Client, job_url: str, to: Console = progress_console) -> JobView:
    """Shows the progress of a job until the job is over; returns the job.

    to: where it is shown; by default on standard error, so that standard output has the report alone.
    """
    columns = (
        TextColumn("{task.description:<11}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"),
        TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=to) as bars:
        task = bars.add_task("queued", total=1.0, left="")
        for kind, data in client.events(job_url):
            match job_event(kind, data):
                case ProgressEvent(stage=stage, progress=progress, remaining_plant_time_s=left):
                    text = "" if left is None else f"about {left:.0f} s of plant time left"
                    bars.update(task, completed=progress, description=stage or "", left=text)
                case StageDoneEvent(stage=stage, plant_time_s=plant_time_s, result=result):
                    found = stage_found(stage, result, "") or "done"
                    line = f"  {stage_name(stage)}: {found} (after {plant_time_s:.1f} s of plant time)"
                    bars.console.print(line, soft_wrap=True, highlight=False, markup=False)
                case NoteEvent(text=text):
                    bars.console.print(f"  note: {text}", soft_wrap=True, highlight=False, markup=False)
                case StateEvent(state=state):
                    bars.update(task, description=state, left="")
        job = JobView.model_validate(client.get(job_url))
        bars.update(task, completed=job.progress)
    return job


def rehearsal_report(found: Rehearsal) -> None:
    """Shows how a rehearsal of a plant file ended, with its figures; where it has none, why comes first."""
    name = "the plant" if found.plant is None else found.plant.name
    if found.ended is not None:
        ended = found.ended
        text = f"rehearsal on {name}: {ended.reason.value}\n{ended.detail}. {ended.advice}"
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    figures = found.result.model_dump() | {"plant_time_s": sum(found.plant_time_s.values())}
    if found.result.new_gains is not None:
        shown = ShownResult.model_validate(figures)
        result_table(shown, None if found.ended else f"rehearsal on {name}", "rehearsed", mv_unit="MV unit")
    if found.ended is None and found.result.comparison is not None:
        console.print(found.result.comparison.verdict, markup=False, highlight=False)


def leaves(value: object, key: str = "") -> Iterator[tuple[str, int | float | str]]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from leaves(item, name)
    elif isinstance(value, int | float | str) and value != "":
        yield key, value


def number(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def job_report(job: JobView, pv_unit: str = "PV unit") -> None:
    """Shows a job with all figures that a decision needs; of a job without a result, why it has none comes first."""
    if job.reason:
        console.print(title(job), markup=False, highlight=False, soft_wrap=True)
        text = f"{job.reason}: {job.detail}\n{job.advice}"
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    heading_new = {JobState.NO_GAIN: "designed", JobState.REHEARSED: "rehearsed"}.get(job.state, "after")
    result_table(ShownResult.model_validate(job), None if job.reason else title(job), heading_new, pv_unit)
    if job.comparison and not job.reason:
        console.print(job.comparison.verdict, markup=False, highlight=False)
    if on := job.rehearsed_on:
        text = f"Rehearsed on {on.plant_text}; {on.gains_text}. Nothing was tested on the loop."
        console.print(text, markup=False, highlight=False)
    for step in next_steps(job):
        console.print(step, markup=False, highlight=False, soft_wrap=True)


class ShownResult(BaseModel):
    """What a table shows of a result: of a job, or of a rehearsal of a plant file."""

    model_config = ConfigDict(from_attributes=True)

    old_gains: GainsView | None = None
    new_gains: GainsView | None = None
    before: StepView | None = None
    after: StepView | None = None
    comparison: ComparisonView | None = None
    predicted: PredictedView | None = None
    predicted_before: PredictedView | None = None
    model: ModelView | TransferModelView | None = None
    model_from: str | None = None
    tried: bool | None = None
    evidence: EvidenceView | None = None
    verification: VerificationView | None = None
    ultimate: UltimateView | None = None
    plant_time_s: float


def result_table(
    shown: ShownResult, title: str | None, heading_new: str, pv_unit: str = "PV unit", mv_unit: str = "%"
) -> None:
    """Shows the figures of a result that are known.

    heading_new: what the new gains are called.
    """
    table = Table(title=title)
    for heading in ("", "before", heading_new, "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for label, before, after, unit in _figures(shown, pv_unit, mv_unit):
        if before not in _NOTHING or after not in _NOTHING:
            table.add_row(label, before, after, unit)
    if table.row_count > 1 or title is not None:  # the plant time alone is no result
        console.print(table)


def _figures(job: ShownResult, pv_unit: str, mv_unit: str) -> Iterator[tuple[str, str, str, str]]:
    """Yields lines of the table: label, before, after, unit."""
    per = f"{mv_unit} per {pv_unit}"
    for name, unit in (("Kp", f"{per} (ISA)"), ("Ti", "s"), ("Td", "s")):
        yield f"gain {name}", figure(job.old_gains, name), figure(job.new_gains, name), unit
    if job.before or job.after:
        for label, name, unit in (
            ("measured IAE", "IAE", f"{pv_unit} s"),
            ("measured overshoot", "overshoot_pct", "%"),
            ("measured settling", "settling_s", "s"),
        ):
            yield label, figure(job.before, name), figure(job.after, name), unit
    for label, was, now, unit in _predicted(job, pv_unit, mv_unit):
        yield f"predicted {label}", was, now, unit
    for label, value, unit in (*_model(job.model, pv_unit, mv_unit), *_certainty(job, mv_unit)):
        yield label, "", value, unit
    if job.ultimate is not None:
        yield "ultimate Ku, Pu", "", ", ".join(figure(job.ultimate, n) for n in ("Ku", "Pu_s")), f"{per}, s"
    yield "plant time", "", cell(job.plant_time_s), "s"


def next_steps(job: JobView) -> list[str]:
    """Returns what can be done next with a job, each with its command."""
    command = f"loopwright job {job.id}"
    plot = f"See the record: {command} --plot job.png"
    match job.state:
        case JobState.QUEUED | JobState.RUNNING:
            return [f"Follow it: {command} --follow", f"End it, with its loop restored: {command} --abort"]
        case JobState.PROPOSED if job.superseded_by is None:
            accept, keep = f"Accept the new gains: {command} --accept", f"Keep the old gains: {command} --rollback"
            return [accept, keep, plot, f"See other gains for the same model: loopwright alternatives {job.id}"]
        case JobState.ACCEPTED:
            return [f"Take the old gains back: {command} --rollback"]
        case JobState.REHEARSED:
            return [f"See what a test of the loop itself would do: loopwright retune {job.loop} --preview"]
    return [plot] if job.record == "kept" else []


def figure(part: BaseModel | None, name: str) -> str:
    """Returns one figure of a part of a result as text, "-" where there is no such part."""
    return cell(None if part is None else getattr(part, name))


def title(job: JobView) -> str:
    """Returns the title of the report, which must not let a rehearsal or an unchanged loop look like a proposal."""
    what = f"job {job.id}: {job.loop} {job.state}"
    if job.state is JobState.NO_GAIN:
        return f"{what}: the loop is already tuned as well as asked, the present gains stay"
    if job.dry_run and (on := job.rehearsed_on):
        done = f"job {job.id}: {job.loop} rehearsed"
        return f"{done if job.state is JobState.REHEARSED else what} on {on.plant_text}, nothing was tested"
    return f"{what}, nothing was tested" if job.dry_run else what


def _predicted(job: ShownResult, pv_unit: str, mv_unit: str) -> Iterator[tuple[str, str, str, str]]:
    """Yields lines of the table: label, before, after, unit."""
    compared = job.comparison
    if compared is None:
        earlier = job.predicted_before
        for label, name, unit in _PREDICTED if earlier or not job.after else _MARGINS:
            yield label, "" if earlier is None else figure(earlier, name), figure(job.predicted, name), unit
        return
    for label, part, name, unit in (
        ("overshoot", None, "overshoot_pct", "%"),
        ("settling, set-point", "setpoint", "settling_s", "s"),
        ("IAE, set-point", "setpoint", "IAE", "s"),
        ("MV travel, set-point", "setpoint", "TV", f"{mv_unit} per {pv_unit}"),
        ("peak, load", "load", "peak", f"{pv_unit} per {mv_unit}"),
        ("settling, load", "load", "settling_s", "s"),
        ("IAE, load", "load", "IAE", f"{pv_unit} s per {mv_unit}"),
        ("MV travel, load", "load", "TV", f"{mv_unit} per {mv_unit}"),
        *((label, None, name, unit) for label, name, unit in _MARGINS),
    ):
        shown = []
        for each in (compared.before, compared.after):
            of = getattr(each, part) if part else each
            shown.append(cell(getattr(of, name)) if each.stable else "unstable")
        yield label, shown[0], shown[1], unit
    yield "J, the cost minimised", cell(compared.J_before), cell(compared.J_after), ""


def _model(
    model: ModelView | TransferModelView | None, pv_unit: str, mv_unit: str
) -> Iterator[tuple[str, str, str]]:
    """Yields lines of the table: label, value, unit."""
    if model is None:
        return
    if not isinstance(model, TransferModelView):
        values = ", ".join(figure(model, name) for name in ("K", "T_s", "L_s"))
        yield "model K, T, L", values, f"{pv_unit} per {mv_unit}, s, s"
        return
    for label, coefficients, errors, unit in (
        ("model num", model.num, model.num_errors, f"{pv_unit} per {mv_unit}"),
        ("model den", model.den, model.den_errors, ""),
    ):
        known = errors or [0.0] * len(coefficients)
        yield label, " ".join(map(_with_error, coefficients, known)), unit
    yield "model dead time", _with_error(model.dead_time_s, model.dead_time_error_s), "s"


def _with_error(value: float, error: float | None) -> str:
    """Returns a value with its standard error, unless the error is negligible."""
    return cell(value) if not error or error < 1e-4 * abs(value) else f"{cell(value)}±{error:.1g}"


def _certainty(job: ShownResult, mv_unit: str) -> Iterator[tuple[str, str, str]]:
    """Yields lines of the table on how certain the result of fast is: label, value, unit."""
    found, step = job.evidence, job.verification
    if job.model_from is not None:
        yield "model from", job.model_from, ""
    if job.tried is False:
        yield "tried on the loop", "never", ""
    if found is not None:
        yield "uncertainty of Ms", cell(found.uncertainty), "(2 std. dev.)"
        yield "Ms, other models", cell(found.ambiguity), "(max. diff.)"
        for load in found.loads:
            yield "load disturbance", f"{load.size:+.4g} at {load.t_s:.4g}", f"{mv_unit}, s into the test"
    if step is not None:
        yield "fit of measured step", f"{step.fit_pct:.1f}", "%"


def loop_report(loop: LoopDetail) -> None:
    """Shows a loop in its present state."""
    live, unit = loop.live, loop.pv_unit
    gains = None if live is None else live.gains
    job, last = loop.active_job, loop.last_job_state
    table = Table("", "now", "unit", title=f"loop {loop.tag}: {loop.description}")
    for label, value, of in (
        ("SP", figure(live, "sp"), unit),
        ("SP from", ", ".join(filter(None, (loop.setpoint_from, loop.outer_loop))), ""),
        ("fast moves it by", ", ".join(loop.test.excitations), ""),
        ("SP moves in a test", loop.test.directions, ""),
        ("SP rate in a test", cell(loop.test.sp_rate_max_per_s), f"{unit}/s"),
        ("PV", figure(live, "pv"), unit),
        ("MV", figure(live, "mv"), "%"),
        ("mode", figure(live, "mode"), ""),
        *(
            (f"gain {name}", figure(gains, name), of)
            for name, of in (("Kp", f"% per {unit}"), ("Ti", "s"), ("Td", "s"))
        ),
        ("nodes", figure(live, "node_state"), ""),
        ("host", loop.host, ""),
        ("job", cell(job or (last and f"none; the last one: {last}")), ""),
        ("locked", cell(lock(loop.locked)), ""),
        ("disturbed by", cell(loop.disturbed_by), ""),
    ):
        table.add_row(label, value, of)
    console.print(table)
    for sentence in knowledge(loop):
        console.print(sentence, highlight=False, markup=False, soft_wrap=True)
    if loop.live_error:
        error = loop.live_error
        console.print(f"The loop cannot be read: {error.detail}. {error.advice}", highlight=False, markup=False)
    if loop.not_confirmed_home:
        console.print(loop.not_confirmed_home.advice, highlight=False)


def knowledge(loop: LoopDetail) -> list[str]:
    """Returns what is known of a loop, in sentences."""
    known = loop.knowledge
    if known is None:
        return ["Nothing is known of Ms as yet."]
    sentences = [f"{known.text[0].upper()}{known.text[1:]}, at {known.at}."]
    if known.Ms is not None:
        sentences[0] = f"{sentences[0][:-1]}: {known.Ms:.3g}."
    if known.pv_range is not None:
        sentences.append(f"It holds for PV {known.pv_range.low:.5g} .. {known.pv_range.high:.5g} {loop.pv_unit}.")
    if known.older_plant is not None:
        sentences.append(f"Not used any more: {known.older_plant}.")
    return sentences


def lock(locked: LockView | None) -> str | None:
    """Returns who has locked a loop, and why; None for a loop that is not locked."""
    return None if locked is None else f"by {locked.by}: {locked.reason}"


def cell(value: object) -> str:
    """Returns a value as text, "-" for None."""
    return "-" if value is None else number(value)


def doing(job: JobView) -> str:
    """Returns the state of a job, with its stage and progress while it runs."""
    if job.state is not JobState.RUNNING:
        return job.state
    return " ".join(filter(None, (f"{job.state}:", job.stage, f"{job.progress:.0%}")))


def ago(at: str, now: datetime) -> str:
    """Returns how long ago something was, in words; the time itself where the clock of this machine is behind it.

    at: the time in the form of ISO 8601. now: the present time.
    """
    passed = (now - datetime.fromisoformat(at)).total_seconds()
    for seconds, unit, largest in ((1.0, "s", 60.0), (60.0, "min", 60.0), (3600.0, "h", 48.0), (86400.0, "days", inf)):
        if passed > -1.0 and passed / seconds < largest:
            return f"{int(max(passed, 0.0) / seconds)} {unit} ago"
    return at


def rows(
    title: str, headings: Iterable[str], lines: Iterable[Iterable[object]], never_cut: Collection[str] = ()
) -> None:
    """Shows a table with a row for each line.

    never_cut: the headings of the columns that stay on one line, however narrow the terminal is.
    """
    table = Table(title=title)
    for heading in headings:
        table.add_column(heading, no_wrap=heading in never_cut)
    for line in lines:
        table.add_row(*map(cell, line))
    console.print(table)
