"""What the demo does with its loop: each method retunes it from the same gains, and all gains are put into one table.

Nothing is accepted, hence the controller has its own gains back before the next method begins.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Table

from loopwright.service.api.job_views import JobView, LiveView, LoopDetail
from loopwright.service.cli import job_tables, terminal
from loopwright.service.cli.client import ApiError, Client, parsed
from loopwright.service.states.job_state import JobState
from loopwright.tuning.analysis.comparison import LoopPerformance, loop_performance
from loopwright.tuning.fast.evaluation.proposal import delayed
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction

METHODS = ("five-stage", "fast", "setpoint")
PLANT = "model-14"
PLANT_MODEL = TransferFunction((0.03, 0.02), (3.0, 4.0, 1.0), 1.0)
"""Model 14 of the catalogue in degC per % of MV: the demo simulates it, and therefore knows it."""
_AT_REST = ("preflight", "settle")
_STAGES = {
    "relay": ("relay", "Ku about {Ku_a:.4g}, Pu about {Pu_a_s:.3g} s"),
    "ultimate": ("Ku by P control", "Ku {Ku:.4g}, Pu {Pu_s:.3g} s"),
    "zn_pi": ("Ziegler-Nichols PI", "Kp {Kp:.4g}, Ti {Ti_s:.3g} s: overshoot {overshoot_pct:.3g} %"),
    "estimate": ("FOPDT from overshoot", "K {K:.3g}, T {T_s:.3g} s, L {L_s:.3g} s"),
    "optimise": ("robust optimisation", "Kp {Kp:.4g}, Ti {Ti:.4g} s"),
}
"""The stages of five-stage: name and finding, by the names in the result of the stage."""


@dataclass(frozen=True, slots=True)
class Demonstration:
    """The retunes of the demo.

    jobs: the jobs, one of each method.
    seconds: the wall time of all of them, s.
    """

    jobs: list[JobView]
    seconds: float

    @property
    def without_proposal(self) -> list[str]:
        """What ended otherwise than as a proposal, in words."""
        return [f"{job.method} ended as {job.state}" for job in self.jobs if job.state is not JobState.PROPOSED]


def demonstrate(client: Client, tag: str, methods: Sequence[str]) -> Demonstration:
    """Retunes the loop by each of the methods, one after the other, and shows what happens.

    A retune that is on its way already is followed instead.
    """
    started = time.monotonic()
    if url := _loop(client, tag).active_job:
        terminal.console.print(f"GET        {client.url}{url}: a retune is on its way", highlight=False)
        return Demonstration([job_tables.follow(client, url, terminal.console)], time.monotonic() - started)
    jobs = []
    for method in methods:
        path = f"/loops/{tag}/retune"
        terminal.console.print(f"POST       {client.url}{path}  method {method}", highlight=False)
        begun = parsed(JobView, client.post(path, {"method": method, "by": "demo"}))
        jobs.append(job_tables.follow(client, begun.url, terminal.console))
    return Demonstration(jobs, time.monotonic() - started)


def report(client: Client, tag: str, shown: Demonstration, plant: TransferFunction | None) -> None:
    """Shows what the stages of five-stage found, and the table of all methods.

    plant: the plant of the loop; None where it is not known, which leaves out the figures on it.
    Raises ApiError if the loop cannot be read.
    """
    loop = _loop(client, tag)
    live = loop.live
    if live is None:
        why = loop.restore_unconfirmed.advice if loop.restore_unconfirmed else "it belongs to another gateway"
        why = f"{loop.live_error.detail}. {loop.live_error.advice}" if loop.live_error else why
        raise ApiError(f"the loop {tag} cannot be read: {why}")
    for job in shown.jobs:
        if len(shown.jobs) == 1 or job.state is not JobState.PROPOSED:
            job_tables.job_report(job, loop.pv_unit)
        if job.method == "five-stage":
            _stages(job, loop.pv_unit)
    terminal.console.print(_table(loop, live, shown.jobs, plant))
    if plant is not None:
        on = f"num {_row(plant.num)}, den {_row(plant.den)}, dead time {plant.L:g} s"
        text = (
            "Ms, overshoot and IAE (of unit steps) are computed on the plant itself, which is simulated and known: "
            f"{on}, and half a sample of delay for the sampling."
        )
        terminal.console.print(text, highlight=False)
    held = ", ".join(f"{name} {terminal.figure(live.gains, name)}" for name in ("Kp", "Ti"))
    held = f"{held}, set-point {terminal.cell(live.sp)}"
    plant_s = sum(job.plant_time_s for job in shown.jobs)
    lines = (
        f"controller       {live.mode}, {held}: its own until a proposal is accepted",
        f"time             {plant_s:.0f} s of plant time in {shown.seconds:.1f} s of wall time",
    )
    terminal.console.print("\n".join(lines), highlight=False, soft_wrap=True)


def _loop(client: Client, tag: str) -> LoopDetail:
    return parsed(LoopDetail, client.get(f"/loops/{tag}"))


def _row(coefficients: Sequence[float]) -> str:
    return " ".join(f"{each:g}" for each in coefficients)


def _stages(job: JobView, pv_unit: str) -> None:
    """Shows what each of the five stages found, as far as the job came."""
    results = {stage.stage: stage for stage in job.stages if stage.result}
    lines = []
    for number, (stage, (name, words)) in enumerate(_STAGES.items(), 1):
        if done := results.get(stage):
            found = words.format_map(dict(terminal.leaves(done.result)))
            lines.append((f"{number} {name}", f"{done.plant_time_s or 0.0:.1f} s", found))
    terminal.rows(f"the five stages; gains in % per {pv_unit}", ("stage", "plant time", "found"), lines)


def _table(loop: LoopDetail, live: LiveView, jobs: Sequence[JobView], plant: TransferFunction | None) -> Table:
    table = Table(title=f"{loop.tag}: present gains and those of each method")
    for heading in ("", "present", *(job.method for job in jobs), "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    unit = loop.pv_unit
    table.add_row("ended as", "", *(job.state for job in jobs), "")
    table.add_row("plant time", "", *(f"{job.plant_time_s:.1f}" for job in jobs), "s")
    table.add_row("before any move", "", *(f"{_rest_s(job):.1f}" for job in jobs), "s")
    gains = [live.gains, *(job.new_gains for job in jobs)]
    for name, of in (("Kp", f"% per {unit}"), ("Ti", "s"), ("b", "")):
        table.add_row(name, *(terminal.figure(each, name) for each in gains), of)
    if plant is None:
        return table
    found = [None if each is None else _on(plant, each.gains(), live.sample_time_s) for each in gains]
    for label, part, name, of in (
        ("Ms", None, "Ms", ""),
        ("overshoot", None, "overshoot_pct", "%"),
        ("IAE, set-point", "setpoint", "IAE", "s"),
        ("IAE, load", "load", "IAE", f"{unit} s per %"),
    ):
        table.add_row(label, *(_figure(each, part, name) for each in found), of)
    return table


def _rest_s(job: JobView) -> float:
    """The plant time before the test moved anything: waiting for rest, and listening."""
    return sum(stage.plant_time_s or 0.0 for stage in job.stages if stage.stage in _AT_REST)


def _on(plant: TransferFunction, gains: Gains, sample_time_s: float) -> LoopPerformance:
    return loop_performance(delayed(plant, 0.5 * sample_time_s), gains, sample_time_s)


def _figure(found: LoopPerformance | None, part: str | None, name: str) -> str:
    if found is None:
        return "-"
    if not found.stable:
        return "unstable"
    return terminal.cell(getattr(getattr(found, part) if part else found, name))
