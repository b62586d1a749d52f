"""Shows jobs and loops on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from pydantic import BaseModel
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from loopwright.service.api.job_views import JobView, LockView, LoopDetail
from loopwright.service.cli.answers import NoteEvent, ProgressEvent, StageDoneEvent, StateEvent, job_event
from loopwright.service.cli.client import Client
from loopwright.service.results import ModelView, TransferModelView
from loopwright.service.states.job_state import JobState

console = Console()
_MARGINS = (("GM", "GM", ""), ("PM", "PM_deg", "deg"), ("Ms", "Ms", ""))
_PREDICTED = (
    ("overshoot", "overshoot_pct", "%"),
    ("settling", "settling_s", "s"),
    ("IAE, unit step", "IAE_per_unit", "s"),
    *_MARGINS,
)
"""Figures of a job of an earlier version, which has no comparison."""


def follow(client: Client, job_url: str) -> JobView:
    """Shows the progress of a job until the job is over; returns the job."""
    columns = (
        TextColumn("{task.description:<11}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"),
        TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as bars:
        task = bars.add_task("queued", total=1.0, left="")
        for kind, data in client.events(job_url):
            match job_event(kind, data):
                case ProgressEvent(stage=stage, progress=progress, remaining_plant_time_s=left):
                    text = "" if left is None else f"about {left:.0f} s of plant time left"
                    bars.update(task, completed=progress, description=stage or "", left=text)
                case StageDoneEvent(stage=stage, plant_time_s=plant_time_s, result=result):
                    line = f"  {stage:<10} at {plant_time_s:.1f} s  {brief(result)}"
                    bars.console.print(line, soft_wrap=True)
                case NoteEvent(text=text):
                    bars.console.print(f"  note: {text}")
                case StateEvent(state=state):
                    bars.update(task, description=state, left="")
        job = JobView.model_validate(client.get(job_url))
        bars.update(task, completed=job.progress)
    return job


def brief(result: Mapping[str, object] | None) -> str:
    """Returns the numbers and texts of a stage's result on one line."""
    return ", ".join(f"{key} {number(value)}" for key, value in leaves(result or {}))


def leaves(value: object, key: str = "") -> Iterator[tuple[str, int | float | str]]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from leaves(item, name)
    elif isinstance(value, int | float | str) and value != "":
        yield key, value


def number(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def job_report(job: JobView, pv_unit: str = "PV unit") -> None:
    """Shows a job as a table, with all figures that a decision needs."""
    table = Table(title=title(job), show_header=True)
    heading_new = {JobState.NO_GAIN: "designed", JobState.REHEARSED: "rehearsed"}.get(job.state, "after")
    for heading in ("", "before", heading_new, "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    per = f"% per {pv_unit}"
    for name, unit in (("Kp", f"{per} (ISA)"), ("Ti", "s"), ("Td", "s")):
        table.add_row(f"gain {name}", figure(job.old_gains, name), figure(job.new_gains, name), unit)
    if job.before or job.after:
        for label, name, unit in (
            ("measured IAE", "IAE", f"{pv_unit} s"),
            ("measured overshoot", "overshoot_pct", "%"),
            ("measured settling", "settling_s", "s"),
        ):
            table.add_row(label, figure(job.before, name), figure(job.after, name), unit)
    for label, was, now, unit in _predicted(job, pv_unit):
        table.add_row(f"predicted {label}", was, now, unit)
    for label, value, unit in (*_model(job.model, pv_unit), *_certainty(job)):
        table.add_row(label, "", value, unit)
    table.add_row("ultimate Ku, Pu", "", ", ".join(figure(job.ultimate, n) for n in ("Ku", "Pu_s")), f"{per}, s")
    table.add_row("plant time", "", cell(job.plant_time_s), "s")
    console.print(table)
    if job.reason:
        console.print(f"[bold]{job.reason}[/bold]: {job.detail}\n{job.advice}", highlight=False)
    elif job.comparison:
        console.print(job.comparison.verdict, markup=False, highlight=False)
    if on := job.rehearsed_on:
        text = f"Rehearsed on {on.plant_text}; {on.gains_text}. Nothing was tested on the loop."
        console.print(text, markup=False, highlight=False)


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


def _predicted(job: JobView, pv_unit: str) -> Iterator[tuple[str, str, str, str]]:
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
        ("MV travel, set-point", "setpoint", "TV", f"% per {pv_unit}"),
        ("peak, load", "load", "peak", f"{pv_unit} per %"),
        ("settling, load", "load", "settling_s", "s"),
        ("IAE, load", "load", "IAE", f"{pv_unit} s per %"),
        ("MV travel, load", "load", "TV", "% per %"),
        *((label, None, name, unit) for label, name, unit in _MARGINS),
    ):
        shown = []
        for each in (compared.before, compared.after):
            of = getattr(each, part) if part else each
            shown.append(cell(getattr(of, name)) if each.stable else "unstable")
        yield label, shown[0], shown[1], unit
    yield "J, the cost minimised", cell(compared.J_before), cell(compared.J_after), ""


def _model(model: ModelView | TransferModelView | None, pv_unit: str) -> Iterator[tuple[str, str, str]]:
    """Yields lines of the table: label, value, unit."""
    if not isinstance(model, TransferModelView):
        yield "model K, T, L", ", ".join(figure(model, n) for n in ("K", "T_s", "L_s")), f"{pv_unit} per %, s, s"
        return
    for label, values, errors, unit in (
        ("model num", model.num, model.num_errors, f"{pv_unit} per %"),
        ("model den", model.den, model.den_errors, ""),
    ):
        known = errors or [0.0] * len(values)
        yield label, " ".join(map(_with_error, values, known)), unit
    yield "model dead time", _with_error(model.dead_time_s, model.dead_time_error_s), "s"


def _with_error(value: float, error: float | None) -> str:
    """Returns a value with its standard error, unless the error is negligible."""
    return cell(value) if not error or error < 1e-4 * abs(value) else f"{cell(value)}±{error:.1g}"


def _certainty(job: JobView) -> Iterator[tuple[str, str, str]]:
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
            yield "load disturbance", f"{load.size:+.4g} at {load.t_s:.4g}", "%, s into the relay"
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


def rows(title: str, headings: Iterable[str], lines: Iterable[Iterable[object]]) -> None:
    """Shows a table with a row for each line."""
    table = Table(*headings, title=title)
    for line in lines:
        table.add_row(*map(cell, line))
    console.print(table)
