"""Shows jobs and loops on a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from loopwright.service.api.job_views import JobView, LockView, LoopDetail
from loopwright.service.api.report.words import stage_found, stage_name
from loopwright.service.api.watch_views import MonitoringView
from loopwright.service.cli import terminal
from loopwright.service.cli.answers import SHOWN_EVENTS, NoteShown, ProgressShown, StageDoneShown, StateShown
from loopwright.service.cli.client import Client, parsed
from loopwright.service.cli.result_table import ShownResult, result_table
from loopwright.service.cli.terminal import cell, figure
from loopwright.service.states.job_state import JobState

if TYPE_CHECKING:
    from loopwright.service.execution.rehearsed import Rehearsal


def follow(client: Client, job_url: str, to: Console | None = None) -> JobView:
    """Shows the progress of a job until the job is over; returns the job.

    to: where it is shown; by default on standard error, so that standard output has the report alone.
    """
    columns = (
        TextColumn("{task.description:<11}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"),
        TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=to or terminal.progress_console) as bars:
        task = bars.add_task("queued", total=1.0, left="")
        for kind, data in client.events(job_url):
            form = SHOWN_EVENTS.get(kind)
            match None if form is None else parsed(form, data):
                case ProgressShown(stage=stage, progress=progress, remaining_plant_time_s=left):
                    text = "" if left is None else f"about {left:.0f} s of plant time left"
                    bars.update(task, completed=progress, description=stage_name(stage), left=text)
                case StageDoneShown(stage=stage, plant_time_s=plant_time_s, result=result):
                    found = stage_found(stage, result, "") or "done"
                    line = f"  {stage_name(stage)}: {found} (after {plant_time_s:.1f} s of plant time)"
                    bars.console.print(line, soft_wrap=True, highlight=False)
                case NoteShown(text=text):
                    bars.console.print(f"  note: {text}", soft_wrap=True, highlight=False)
                case StateShown(state=state):
                    bars.update(task, description=state, left="")
        job = parsed(JobView, client.awaited(job_url))
        # how far a job is may be told once more after its end
        bars.update(task, completed=job.progress, description=job.state, left="")
    return job


def rehearsal_report(found: Rehearsal) -> None:
    """Shows how a rehearsal of a plant file ended, with its figures; where it has none, why comes first."""
    name = "the plant" if found.plant is None else found.plant.name
    if found.ended is not None:
        ended = found.ended
        text = f"rehearsal on {name}: {ended.reason.value}\n{ended.detail}. {ended.advice}"
        terminal.console.print(text, highlight=False, soft_wrap=True)
    figures = found.result.model_dump() | {"plant_time_s": sum(found.plant_time_s.values())}
    if found.result.new_gains is not None:
        shown = ShownResult.model_validate(figures)
        result_table(shown, None if found.ended else f"rehearsal on {name}", "rehearsed", mv_unit="MV unit")
    if found.ended is None and found.result.comparison is not None:
        terminal.console.print(found.result.comparison.verdict, highlight=False)


def job_report(job: JobView, pv_unit: str = "PV unit") -> None:
    """Shows a job with all figures that a decision needs; of a job without a result, why it has none comes first."""
    in_words = job.reason is not None or job.new_gains is None
    if in_words:
        _say(title(job))
    if job.reason:
        _say(f"{job.reason}: {job.detail}\n{job.advice}")
    heading_new = {JobState.NO_GAIN: "designed", JobState.REHEARSED: "rehearsed"}.get(job.state, "new")
    result_table(ShownResult.model_validate(job), None if in_words else title(job), heading_new, pv_unit)
    if job.comparison and not job.reason:
        terminal.console.print(job.comparison.verdict, highlight=False)
    if on := job.rehearsed_on:
        text = f"Rehearsed on {on.plant_text}; {on.gains_text}. Nothing was tested on the loop."
        terminal.console.print(text, highlight=False)
    if job.monitoring is not None:
        for sentence in monitoring(job.monitoring):
            _say(sentence)
    _show_next_steps(job)


def decision_report(job: JobView, pv_unit: str = "PV unit") -> None:
    """Shows a job that was just decided about: the gains that the loop has now, and what can be done next."""
    _say(title(job))
    gains = job.new_gains if job.state is JobState.ACCEPTED else job.previous_gains
    if gains is not None:
        terms = [f"Kp {cell(gains.Kp)} % per {pv_unit}", f"Ti {cell(gains.Ti)} s"]
        terms += [f"Td {cell(gains.Td)} s"] if gains.Td else []
        terms += [f"b {cell(gains.b)}"] if gains.b != 1.0 else []
        which = "the new" if job.state is JobState.ACCEPTED else "its previous"
        _say(f"{job.loop} has {', '.join(terms)}: {which} gains")
    _show_next_steps(job)


def _show_next_steps(job: JobView) -> None:
    for step in next_steps(job):
        _say(step)


def _say(text: str) -> None:
    """Shows a text whose lines are not broken: it can be copied."""
    terminal.console.print(text, highlight=False, soft_wrap=True)


def next_steps(job: JobView) -> list[str]:
    """Returns what can be done next with a job, each with its command."""
    command = f"loopwright job {job.id}"
    plot = f"See the record: {command} --plot job.png"
    match job.state:
        case JobState.QUEUED | JobState.RUNNING:
            return [f"Follow it: {command} --follow", f"End it, with its loop restored: {command} --abort"]
        case JobState.PROPOSED if job.superseded_by is None:
            accept, keep = f"Accept the new gains: {command} --accept", f"Keep the previous gains: {command} --rollback"
            return [accept, keep, plot, f"See other gains for the same model: loopwright alternatives {job.id}"]
        case JobState.ACCEPTED:
            return [f"Put the previous gains back: {command} --rollback"]
        case JobState.REHEARSED:
            return [f"See what a test of the loop itself would do: loopwright retune {job.loop} --preview"]
    return [plot] if job.record == "kept" else []


def title(job: JobView) -> str:
    """Returns the title of the report, which must not let a rehearsal or an unchanged loop look like a proposal."""
    what = f"job {job.id}: {job.loop} {job.state}"
    if job.state is JobState.NO_GAIN:
        return f"{what}: the loop is already tuned as well as asked, the present gains stay"
    if job.dry_run and (on := job.rehearsed_on):
        done = f"job {job.id}: {job.loop} rehearsed"
        return f"{done if job.state is JobState.REHEARSED else what} on {on.plant_text}, nothing was tested"
    return f"{what}, nothing was tested" if job.dry_run else what


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
            for name, of in (("Kp", f"% per {unit}"), ("Ti", "s"), ("Td", "s"), ("b", ""))
        ),
        ("nodes", figure(live, "node_state"), ""),
        ("gateway", loop.gateway, ""),
        ("job", cell(job or (last and f"none; the last one: {last}")), ""),
        ("locked", cell(lock(loop.locked)), ""),
        ("disturbed by", cell(loop.disturbed_by), ""),
    ):
        table.add_row(label, value, of)
    terminal.console.print(table)
    for sentence in knowledge(loop):
        terminal.console.print(sentence, highlight=False, soft_wrap=True)
    if loop.monitoring is not None:
        for sentence in monitoring(loop.monitoring):
            terminal.console.print(sentence, highlight=False, soft_wrap=True)
    if loop.live_error:
        error = loop.live_error
        text = f"The loop cannot be read: {error.detail}. {error.advice}"
        terminal.console.print(text, highlight=False)
    if loop.restore_unconfirmed:
        terminal.console.print(loop.restore_unconfirmed.advice, highlight=False)
    if loop.not_acknowledged:
        terminal.console.print(loop.not_acknowledged, highlight=False, soft_wrap=True)


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
    if known.superseded is not None:
        sentences.append(f"Not used any more: {known.superseded}.")
    return sentences


def monitoring(found: MonitoringView) -> list[str]:
    """Returns what the monitoring after an acceptance has come to, in sentences."""
    sentences = [found.message]
    if found.active:
        sentences.append(f"The loop is monitored: {len(found.changes)} of {found.requested} changes were compared.")
        if found.auto_rollback_off is not None:
            sentences.append(f"The previous gains are not put back automatically: {found.auto_rollback_off}.")
        elif not found.auto_rollback:
            sentences.append("The previous gains are not put back automatically: that was not asked for.")
    return sentences


def lock(locked: LockView | None) -> str | None:
    """Returns who has locked a loop, and why; None for a loop that is not locked."""
    return None if locked is None else f"by {locked.by}: {locked.reason}"


def doing(job: JobView) -> str:
    """Returns the state of a job, with its stage and progress while it runs."""
    if job.state is not JobState.RUNNING:
        return job.state
    return " ".join(filter(None, (f"{job.state}:", stage_name(job.stage), f"{job.progress:.0%}")))
