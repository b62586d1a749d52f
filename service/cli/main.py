"""The `loopwright` command: hands over to the processes, and is a client of the service's HTTP API."""

from __future__ import annotations

import errno
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from loopwright.service.cli import data, keys, loops, tuning
from loopwright.service.cli.client import DEFAULT_URL, ApiError, Client
from loopwright.service.cli.output import AsJson, Url, die, on_terminal, print_json, read_json_object

app = typer.Typer(
    help="Retunes PI loops by itself, over CANopen, and ends safe whatever fails.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(keys.app, name="key")
app.add_typer(data.app)
app.add_typer(loops.app)
_HAND_OVER: dict[str, Any] = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def main() -> None:
    try:
        app()
    except ApiError as error:
        print(f"loopwright: {error}", file=sys.stderr)
        sys.exit(1)


# The processes. Imported here and nowhere else in the service: they meet it on the bus only.
@app.command(context_settings=_HAND_OVER, add_help_option=False)
def plant(context: typer.Context) -> None:
    """A simulated plant on the bus (see plant --help)."""
    from loopwright.plantsim.__main__ import main as run

    sys.exit(run(context.args))


@app.command(context_settings=_HAND_OVER, add_help_option=False)
def controller(context: typer.Context) -> None:
    """A PI(D) controller on the bus (see controller --help)."""
    from loopwright.controller.__main__ import main as run

    sys.exit(run(context.args))


@app.command(context_settings=_HAND_OVER, add_help_option=False)
def hub(context: typer.Context) -> None:
    """A CAN bus on 127.0.0.1 for systems without SocketCAN (see hub --help)."""
    from loopwright.protocol.hub import main as run

    sys.exit(run(context.args))


@app.command()
def serve(
    loops: Annotated[Path, typer.Option(help="The loops, YAML.")] = Path("loops.yaml"),
    data: Annotated[Path, typer.Option(help="Folder for jobs and samples.")] = Path("data"),
    bind: Annotated[str, typer.Option(help="Address to listen on; others than loopback need keys.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on; 0: any free one.", min=0, max=65535)] = 8080,
    database: Annotated[
        str | None,
        typer.Option(envvar="LOOPWRIGHT_DATABASE", help="postgresql://..., shared by several hosts; default: a file."),
    ] = None,
    host: Annotated[
        str | None, typer.Option(envvar="LOOPWRIGHT_HOST", help="Name of this host among those of a shared database.")
    ] = None,
    node: Annotated[
        str, typer.Option(envvar="LOOPWRIGHT_NODE", help="Our CANopen node id, another one at each gateway of a bus.")
    ] = "0x7D",
    resume: Annotated[bool, typer.Option(help="Go on with jobs that a crash has cut off.")] = True,
    auth: Annotated[
        bool | None, typer.Option("--auth/--no-auth", help="Ask for keys. Default: unless only this machine is served.")
    ] = None,
    max_body: Annotated[
        int, typer.Option(min=1024, envvar="LOOPWRIGHT_MAX_BODY", help="Longest body of a request, bytes.")
    ] = 1_048_576,
    rate: Annotated[
        float, typer.Option(min=0.1, envvar="LOOPWRIGHT_RATE", help="Requests/s of one caller; twice that at once.")
    ] = 500.0,
    at_once: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_AT_ONCE", help="Requests answered at once, of all callers.")
    ] = 64,
    streams: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_STREAMS", help="Event streams open at once, of all callers.")
    ] = 200,
    computations: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_COMPUTATIONS", help="Tunings computed at once, of all callers.")
    ] = 2,
    live_cpu_s: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_LIVE_CPU_S", help="Processor time of a live loop's computation, s.")
    ] = 120,
    tuning_cpu_s: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_TUNING_CPU_S", help="Processor time of a tuning, s.")
    ] = 60,
    dry_run_cpu_s: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_DRY_RUN_CPU_S", help="Processor time of a dry run, s.")
    ] = 300,
    computation_memory_mb: Annotated[
        int,
        typer.Option(min=16, envvar="LOOPWRIGHT_COMPUTATION_MEMORY_MB", help="Memory of one computation, MB."),
    ] = 512,
    connections: Annotated[
        int, typer.Option(min=16, envvar="LOOPWRIGHT_CONNECTIONS", help="Most connections; half of one address.")
    ] = 512,
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS[/NET]",
            envvar="LOOPWRIGHT_TRUSTED_PROXIES",
            help="Believe X-Forwarded-For of this proxy; may be repeated. Default: of none.",
        ),
    ] = None,
    keep_jobs: Annotated[
        int | None,
        typer.Option(min=1, envvar="LOOPWRIGHT_KEEP_JOBS", help="Keep samples of so many jobs per loop; default: all."),
    ] = None,
    keep_days: Annotated[
        float | None,
        typer.Option(min=0.0, max=36_500, envvar="LOOPWRIGHT_KEEP_DAYS", help="Keep samples so long; default: ever."),
    ] = None,
    log_format: Annotated[
        str, typer.Option(envvar="LOOPWRIGHT_LOG_FORMAT", help="text, or json: one object a line.")
    ] = "text",
) -> None:
    """The service: REST over jobs that retune live loops."""
    from argparse import ArgumentTypeError
    from ipaddress import ip_network

    from sqlalchemy.exc import SQLAlchemyError

    from loopwright.protocol.device_process import node_id
    from loopwright.service.api.gate.limits import RequestLimits
    from loopwright.service.execution.computing.limits import ComputingLimits
    from loopwright.service.inputs.config import ConfigError
    from loopwright.service.jobs.retention import RetentionPolicy
    from loopwright.service.server.serving import NotSafe, Setup
    from loopwright.service.server.serving import serve as run
    from loopwright.service.store.database import BadDatabase
    from loopwright.service.store.store import FolderInUse, ForeignLoop

    if log_format not in ("text", "json"):
        die(f"--log-format must be text or json, not {log_format!r}", 2)
    limits = RequestLimits(
        body_bytes=max_body,
        rate_per_s=rate,
        burst=max(1, round(2 * rate)),
        at_once=at_once,
        streams_at_once=streams,
        computations_at_once=computations,
        connections=connections,
        connections_of_address=connections // 2,
    )
    try:
        proxies = tuple(ip_network(each) for each in trusted_proxy or ())
    except ValueError as error:
        die(f"--trusted-proxy takes an address or a network, as 10.0.0.7 or 10.0.0.0/24: {error}", 2)
    try:
        own_node = node_id(node)
    except (ValueError, ArgumentTypeError):
        die(f"--node must be a CANopen node id, 1 to 127 (0x01 to 0x7F), not {node!r}", 2)
    setup = Setup(
        loops, data, bind, port, database, host, resume,
        node=own_node, auth=auth, limits=limits, log_format="json" if log_format == "json" else "text",
        keep=RetentionPolicy(keep_jobs, keep_days), trusted_proxies=proxies,
        computing=ComputingLimits(live_cpu_s, tuning_cpu_s, dry_run_cpu_s, computation_memory_mb),
    )  # fmt: skip
    try:
        run(setup)
    except (ConfigError, FolderInUse, ForeignLoop, BadDatabase, NotSafe) as error:
        die(str(error), 2)
    except SQLAlchemyError as error:
        die(f"the database cannot be used: {getattr(error, 'orig', None) or error}", 2)
    except OSError as error:
        if data.exists() and not data.is_dir():
            die(f"cannot write to {data}: it is a file, --data takes a folder", 2)
        if error.errno == errno.EADDRINUSE:
            die(f"cannot listen on {bind}:{port}, another program does: choose another with --port", 2)
        die(f"cannot listen on {bind}:{port} or write to {data}: {error.strerror or error}", 2)


@app.command("loops")
def list_loops(url: Url = DEFAULT_URL, as_json: AsJson = False) -> None:
    """The configured loops."""
    from loopwright.service.api.job_views import LoopView
    from loopwright.service.cli import job_tables

    found = Client(url).pages("/loops")
    if as_json:
        print_json(found)
        return
    loops = [LoopView.model_validate(each) for each in found]
    shown = ("tag", "description", "bus", "controller_node", "pv_unit", "t95_s", "active_job")
    job_tables.rows(
        "loops",
        ("tag", "description", "bus", "node", "unit", "T95 s", "job", "locked"),
        ((*(getattr(each, name) for name in shown), job_tables.lock(each.locked)) for each in loops),
    )


@app.command()
def retune(
    loop: Annotated[str, typer.Argument(help="Tag of the loop; with * or ? every loop whose tag is so.")],
    preview: Annotated[bool, typer.Option("--preview", help="Only tell what it would do; nothing is moved.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Start without asking.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Rehearse in memory; the loop is not touched.")] = False,
    sp_deviation: Annotated[float | None, typer.Option(help="Permitted set-point step, PV units.")] = None,
    mv_low: Annotated[float | None, typer.Option(help="Lowest MV during the test, percent.")] = None,
    mv_high: Annotated[float | None, typer.Option(help="Highest MV during the test, percent.")] = None,
    method: Annotated[str | None, typer.Option(help="fast, five-stage or a rule; default: fast.")] = None,
    ms: Annotated[float | None, typer.Option(help="Of fast: 1.2 robust .. 1.6 .. 2.0 fast.")] = None,
    derivative: Annotated[bool, typer.Option("--derivative", help="Of fast: a PID, where it pays.")] = False,
    amplitude: Annotated[float | None, typer.Option(help="Of fast's relay, percent of MV.")] = None,
    careful: Annotated[bool, typer.Option("--careful", help="Of fast: six switches at least.")] = False,
    verify: Annotated[bool, typer.Option(help="The set-point step under the new gains.")] = True,
    propose_anyway: Annotated[
        bool, typer.Option("--propose-anyway", help="Also where nothing asked for gets better by more than 5 %.")
    ] = False,
    wait: Annotated[bool, typer.Option(help="Show progress until the job is over.")] = True,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Retune a loop, with live progress. Exit 0: proposed, rehearsed, or no gain to be had; 3: it ended otherwise, or
    (--preview) would be refused."""
    many = any(character in loop for character in "*?")
    if not (preview or yes or dry_run or on_terminal()):
        die("a retune moves the process: look at it with --preview, and start it with --yes", 2)
    client = Client(url)
    wishes = {
        "sp_deviation": sp_deviation, "mv_low": mv_low, "mv_high": mv_high, "dry_run": dry_run or None,
        "method": method, "ms": ms, "derivative": derivative or None, "amplitude_pct": amplitude,
        "careful": careful or None, "verify": None if verify else False, "propose_anyway": propose_anyway or None,
        "pattern": loop if many else None,
    }  # fmt: skip
    body = {name: value for name, value in wishes.items() if value is not None} | {"requested_by": "cli"}
    path = "/retunes" if many else f"/loops/{loop}/retune"
    if preview:
        raise typer.Exit(0 if _previewed(client, path, body, alone=True, as_json=as_json) else 3)
    if not (yes or dry_run):
        _previewed(client, path, body)
        if not typer.confirm("Start?", err=True):
            die("not started", 1)
    started = client.post(path, body)
    if many:
        raise typer.Exit(_many(client, started, wait, as_json))
    raise typer.Exit(_one(client, started, wait, as_json))


def _previewed(client: Client, path: str, body: dict[str, Any], *, alone: bool = False, as_json: bool = False) -> bool:
    """Tells what would be done; whether it would start. Before a question standard output is left to the report."""
    from rich.console import Console

    from loopwright.service.cli import preview_tables
    from loopwright.service.planning.preview import FleetPreview, Preview

    told = client.post(f"{path}/preview", body)
    found = FleetPreview.model_validate(told) if "count" in told else Preview.model_validate(told)
    if as_json:
        print_json(told)
    else:
        preview_tables.show(found, Console(stderr=not alone))
    return found.would_start == (found.count if isinstance(found, FleetPreview) else True)


def _one(client: Client, started: dict[str, Any], wait: bool, as_json: bool) -> int:
    """Follows a job; the exit status."""
    from loopwright.service.api.job_views import JobView
    from loopwright.service.cli import job_tables
    from loopwright.service.job_states import GOOD

    job = JobView.model_validate(started)
    if wait and as_json:
        for _ in client.events(job.url):
            pass
        job = JobView.model_validate(client.get(job.url))
    elif wait:
        job = job_tables.follow(client, job.url)
    if as_json:
        print_json(job.model_dump(mode="json"))
    else:
        job_tables.job_report(job)
    return 3 if wait and job.state not in GOOD else 0


def _many(client: Client, started: dict[str, Any], wait: bool, as_json: bool) -> int:
    """Follows a retune of many loops; the exit status."""
    from loopwright.service.cli import fleet_tables
    from loopwright.service.job_states import GOOD

    found = fleet_tables.follow(client, started["url"], quiet=as_json) if wait else started
    if as_json:
        print_json(found)
    else:
        fleet_tables.report(found)
    return 3 if wait and any(each["state"] not in GOOD for each in found["loops"]) else 0


@app.command()
def dismiss(
    loop: Annotated[str, typer.Argument(help="Tag of the loop.")], url: Url = DEFAULT_URL, as_json: AsJson = False
) -> None:
    """Answer for a loop that was not confirmed home after a job: it is looked after no more."""
    found = Client(url).post(f"/loops/{loop}/dismiss", {"by": "cli"})
    if as_json:
        print_json(found)
    elif found["jobs"]:
        print(f"{loop} is looked after no more ({', '.join(found['jobs'])})")
    else:
        print(f"{loop} was not looked after")


@app.command("jobs")
def list_jobs(
    loop: Annotated[str | None, typer.Option(help="Only of this loop.")] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """The latest jobs."""
    from loopwright.service.cli import job_tables

    found = Client(url).get("/jobs", loop=loop)
    if as_json:
        print_json(found)
        return
    lines = ((x["id"], x["loop"], x["state"], x["stage"], x["progress"], x["reason"], x["created_at"]) for x in found)
    job_tables.rows("jobs", ("id", "loop", "state", "stage", "progress", "reason", "created"), lines)


@app.command("job")
def one_job(
    job_id: Annotated[str, typer.Argument(metavar="ID", help="Id of the job.")],
    follow: Annotated[bool, typer.Option("--follow", help="Show progress until it is over.")] = False,
    abort: Annotated[bool, typer.Option("--abort", help="Stop it; its loop is restored.")] = False,
    accept: Annotated[bool, typer.Option("--accept", help="Put the proposed gains into the controller.")] = False,
    rollback: Annotated[bool, typer.Option("--rollback", help="Decline, or put the old gains back.")] = False,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Its picture: .png, .svg or .pdf.")] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """A job; or a decision about it."""
    from loopwright.service.api.job_views import JobView
    from loopwright.service.cli import job_tables

    client = Client(url)
    path = f"/jobs/{job_id}"
    wishes = [name for name, wanted in (("abort", abort), ("accept", accept), ("rollback", rollback)) if wanted]
    if len(wishes) > 1:
        die("one decision at a time", 2)
    job = JobView.model_validate(client.post(f"{path}/{wishes[0]}", {"by": "cli"}) if wishes else client.get(path))
    if follow:
        job = job_tables.follow(client, path)
    if plot is not None:
        from loopwright.service.plots.job import NoPicture, job_picture

        tuning.check_plot(plot)
        unit = client.get(f"/loops/{job.loop}")["pv_unit"]
        try:
            job_picture(plot, client.samples_of(job.url), job, unit)
        except NoPicture as error:
            die(str(error), 1)
        except OSError as error:
            die(f"{plot}: {error.strerror}", 2)
    if as_json:
        print_json(job.model_dump(mode="json"))
    else:
        job_tables.job_report(job)


@app.command("alternatives")
def alternatives_of_job(
    job_id: Annotated[str, typer.Argument(metavar="ID", help="Id of the job.")],
    ms: Annotated[float | None, typer.Option(help="Gains of fast for this Ms, from the same record.")] = None,
    derivative: Annotated[bool | None, typer.Option(help="With --ms: a PID where it pays.")] = None,
    method: Annotated[str | None, typer.Option(help="Only this method.")] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Other gains for what a job found, and what they would do; no experiment."""
    wishes = {"ms": ms, "derivative": None if derivative is None else str(derivative).lower(), "method": method}
    found = Client(url).get(f"/jobs/{job_id}/alternatives", **wishes)
    if as_json:
        print_json(found)
        return
    from loopwright.service.cli import tuning_tables

    tuning_tables.tunings(found)
    tuning_tables.to_try(found)


@app.command("rehearse")
def rehearse_file(
    plant_file: Annotated[Path, typer.Argument(metavar="PLANT.json", help="The plant, see docs.")],
    method: Annotated[str, typer.Option(help="fast, five-stage, or a rule of `loopwright methods`.")] = "fast",
    ms: Annotated[float | None, typer.Option(help="Of fast: 1.2 robust .. 1.6 .. 2.0 fast.")] = None,
    derivative: Annotated[bool, typer.Option("--derivative", help="Of fast: a PID, where it pays.")] = False,
    propose_anyway: Annotated[
        bool, typer.Option("--propose-anyway", help="Also where nothing asked for gets better by more than 5 %.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """The whole procedure on a plant model, in memory at full speed. Exits 0 whenever it answered."""
    from loopwright.service.cli import job_tables
    from loopwright.service.execution.rehearsal import rehearse
    from loopwright.tuning.plan import Event, StageStarted

    spec = read_json_object(plant_file)

    def tell(event: Event) -> None:
        if isinstance(event, StageStarted):
            job_tables.console.print(f"  {event.stage:<10} about {event.expected_s:.0f} s")

    # With --json the answer is all there is on standard output.
    listener = None if as_json else tell
    wishes = {"Ms": ms, "derivative": derivative or None}
    options: dict[str, Any] = {name: value for name, value in wishes.items() if value is not None}
    if options and method != "fast":
        die(f"--ms and --derivative are of the method fast, not of {method}", 2)
    answer = rehearse(spec, method=method, on_event=listener, propose_anyway=propose_anyway, **options).as_json()
    if as_json:
        print_json(answer)
    else:
        job_tables.console.print_json(data={k: v for k, v in answer.items() if k not in ("stages", "input")})


app.command("methods")(tuning.methods)
app.command("tune")(tuning.tune)
app.command("identify")(tuning.identify)


@app.command()
def demo(
    folder: Annotated[
        Path | None, typer.Option(help="Keep picture and data here; default: a new temporary folder.")
    ] = None,
    speed: Annotated[str, typer.Option(help="Speed of the plant: max, or a factor of real time.")] = "max",
    hub_only: Annotated[bool, typer.Option("--hub", help="Use the loopback hub even if there is a vcan0.")] = False,
) -> None:
    """Retunes a badly tuned loop before your eyes: bus, plant, controller and service as processes."""
    from loopwright.service.cli.demo import DemoFailed, run_demo

    try:
        run_demo(folder, speed, hub_only)
    except DemoFailed as error:
        die(str(error), 1)
