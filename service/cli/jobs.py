"""`loopwright jobs`, `loopwright batches`, `loopwright job`, `loopwright report` and `loopwright alternatives`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

import typer

from loopwright.service.cli.client import DEFAULT_URL, Client, parsed
from loopwright.service.cli.output import (
    AsJson,
    AskedAim,
    AskedMvPeak,
    AskedNoiseGain,
    AskedSettling,
    AskedWeight,
    Url,
    die,
    job_going_on,
    print_json,
)
from loopwright.service.cli.tuning import check_plot
from loopwright.service.cli.whole_file import written_whole
from loopwright.service.states.job_state import JobState

if TYPE_CHECKING:
    from loopwright.service.api.job_views import JobView

app = typer.Typer()

LAST = "last"
ID_LENGTH = 12
"""Number of characters of the id of a job; fewer are the beginning of an id."""
_SURE = 4
"""Number of characters of an id that a decision takes at least: fewer are a slip as easily as an id."""
_FEW = 5
JobId = Annotated[
    str,
    typer.Argument(metavar="ID", help="Id of the job, or as much of its beginning as no other has; last: the latest."),
]


def path_of(client: Client, given: str) -> str:
    """Returns the path of a job. Ends the command with status 2 where several jobs, or none, may be meant.

    given: the id of the job, the beginning of it, or `last`.
    """

    from loopwright.service.api.job_views import JobView

    if not given:
        die("the id of the job is empty, as from a variable that is not set; see: loopwright jobs", 2)
    if given == LAST:
        wanted: dict[str, str | float | None] = {"limit": 1}
    elif len(given) < ID_LENGTH:
        wanted = {"id": given, "limit": _FEW}
    else:
        return f"/jobs/{quote(given, safe='')}"
    found = parsed(list[JobView], client.get("/jobs", **wanted))
    if not found and given == LAST:
        die("there is no job yet; begin one with: loopwright retune TAG", 2)
    if not found:
        die(f"no job has an id that begins with {given!r}; see: loopwright jobs", 2)
    if len(found) > 1:
        ids = ", ".join(f"{job.id} ({job.loop})" for job in found)
        more = " and perhaps more" if len(found) == _FEW else ""
        die(f"several jobs have an id that begins with {given!r}: {ids}{more}; give more of the id", 2)
    return f"/jobs/{found[0].id}"


def unit_of(client: Client, tag: str) -> str:
    """Returns the unit of PV of a loop, as configured; no controller is asked. The words of a table for a loop that is
    not configured any more."""
    from loopwright.service.api.job_views import LoopView

    loops = parsed(list[LoopView], client.pages("/loops"))
    return next((loop.pv_unit for loop in loops if loop.tag == tag), "PV unit")


@app.command("jobs")
def list_jobs(
    loop: Annotated[str | None, typer.Option(help="Only jobs of this loop.")] = None,
    state: Annotated[JobState | None, typer.Option(help="Only jobs in this state.")] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """List the latest jobs."""
    from datetime import UTC, datetime

    from loopwright.service.api.job_views import JobView
    from loopwright.service.cli import job_tables, terminal

    found = Client(url).get("/jobs", loop=loop, state=state)
    if as_json:
        print_json(found)
        return
    jobs, now = parsed(list[JobView], found), datetime.now(UTC)
    terminal.rows(
        "jobs",
        ("id", "loop", "state", "reason", "created"),
        ((x.id, x.loop, job_tables.doing(x), x.reason, terminal.ago(x.created_at, now)) for x in jobs),
        never_cut=("id", "created"),
    )


@app.command("batches")
def list_batches(url: Url = DEFAULT_URL, as_json: AsJson = False) -> None:
    """List the latest batches."""
    from datetime import UTC, datetime

    from loopwright.service.cli import fleet_tables
    from loopwright.service.cli.answers import BatchSummaryShown

    found = Client(url).get("/batches")
    if as_json:
        print_json(found)
        return
    fleet_tables.summaries(parsed(list[BatchSummaryShown], found), datetime.now(UTC))


@app.command("job")
def one_job(
    job_id: JobId,
    follow: Annotated[bool, typer.Option("--follow", help="Show the progress until the job is over.")] = False,
    abort: Annotated[bool, typer.Option("--abort", help="Abort the job; its loop is restored.")] = False,
    accept: Annotated[
        bool, typer.Option("--accept", help="Accept the proposal: write its gains to the controller.")
    ] = False,
    auto_rollback: Annotated[
        bool,
        typer.Option(
            help="With --accept: have the previous gains put back while the loop is monitored, if PV leaves its limits "
            "or an oscillation grows."
        ),
    ] = True,
    rollback: Annotated[
        bool, typer.Option("--rollback", help="Decline the proposal, or restore the previous gains.")
    ] = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a plot of the job: .png, .svg or .pdf.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Show a job, or decide on it."""
    from loopwright.service.api.job_views import JobView
    from loopwright.service.cli import job_tables

    check_plot(plot)
    client = Client(url)
    path = path_of(client, job_id)
    decisions = [name for name, wanted in (("abort", abort), ("accept", accept), ("rollback", rollback)) if wanted]
    if len(decisions) > 1:
        die("only one of --abort, --accept and --rollback can be given", 2)
    short = len(job_id) < _SURE
    if (accept or rollback) and (job_id == LAST or short):  # somebody else's job may have begun meanwhile
        found = parsed(JobView, client.get(path))
        takes = f"at least {_SURE} characters of an id" if short else "an id"
        which = f"{job_id} begins that of" if short else "the last job is"
        die(f"--{decisions[0]} writes to a loop and takes {takes}: {which} {found.id}, of {found.loop}", 2)
    if not accept and not auto_rollback:
        die("--no-auto-rollback is for --accept", 2)
    given: dict[str, object] = {"by": "cli"} | ({"auto_rollback": auto_rollback} if accept else {})
    job = parsed(JobView, client.post(f"{path}/{decisions[0]}", given) if decisions else client.get(path))
    if follow:
        with job_going_on(job.id):
            job = job_tables.follow(client, path)
    if as_json:
        print_json(job.model_dump(mode="json"))
    elif decisions and job.state in (JobState.ACCEPTED, JobState.ROLLED_BACK):
        job_tables.decision_report(job, unit_of(client, job.loop))
    else:
        job_tables.job_report(job, unit_of(client, job.loop))
    if plot is not None:  # last: what was decided is told whether or not there is a plot
        _save_plot(plot, client, job)


def _save_plot(plot: Path, client: Client, job: JobView) -> None:
    """Writes the plot of a job; ends the command with status 1 where there is none, since the job is told already."""
    from loopwright.service.cli.plots.job import NoPicture, job_picture

    try:
        job_picture(plot, client.samples_of(job.url), job, unit_of(client, job.loop))
    except NoPicture as error:
        die(str(error), 1)
    except OSError as error:
        die(f"{plot}: {error.strerror}", 1)


@app.command("report")
def report_of_job(
    job_id: JobId,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File to write; default: loopwright-LOOP-ID.html in this folder; -: print."),
    ] = None,
    url: Url = DEFAULT_URL,
) -> None:
    """Write the report of a job that is over: one HTML file, to be printed or filed."""
    client = Client(url)
    name, text = client.file(f"{path_of(client, job_id)}/report")
    if output == Path("-"):
        print(text, end="")
        return
    file = output or Path(name)
    if output is None and file.exists():
        die(f"{file} exists already: name another file with --output, or the same to replace it", 2)
    try:
        with written_whole(file) as new:
            new.write_text(text, encoding="utf-8")
    except OSError as error:
        die(f"{file}: {error.strerror}", 2)
    print(file)


@app.command("alternatives")
def alternatives_of_job(
    job_id: JobId,
    ms: Annotated[float | None, typer.Option(help="Gains that fast designs for this Ms from the same record.")] = None,
    derivative: Annotated[
        bool | None, typer.Option(help="With --ms: design a PID where it is better than a PI.")
    ] = None,
    aim: AskedAim = None,
    settling_s: AskedSettling = None,
    mv_peak: AskedMvPeak = None,
    noise_gain: AskedNoiseGain = None,
    setpoint_weight_max: AskedWeight = None,
    method: Annotated[str | None, typer.Option(help="Only this method.")] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Show other gains for the model that a job found, with their figures; no experiment is made."""
    wanted = None if derivative is None else str(derivative).lower()
    client = Client(url)
    found = client.computed(
        f"{path_of(client, job_id)}/alternatives", Ms=ms, derivative=wanted, aim=aim, settling_s=settling_s,
        mv_peak=mv_peak, noise_gain=noise_gain, setpoint_weight_max=setpoint_weight_max, method=method,
    )  # fmt: skip
    if as_json:
        print_json(found)
        return
    from loopwright.service.api.tuning_views import AlternativesView
    from loopwright.service.cli import tuning_tables

    alternatives = parsed(AlternativesView, found)
    tuning_tables.tunings(alternatives)
    tuning_tables.to_try(alternatives)
