"""The `loopwright` command: starts the processes, and is a client of the service's HTTP API."""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

import typer

from loopwright.service.cli import alarms, data, identification, jobs, keys, loops, rehearse, tuning, webhooks
from loopwright.service.cli.client import DEFAULT_URL, ApiError, Client, parsed
from loopwright.service.cli.output import (
    AsJson,
    AskedAim,
    AskedMvPeak,
    AskedNoiseGain,
    AskedSettling,
    AskedWeight,
    Url,
    die,
    going_on,
    job_going_on,
    on_terminal,
    print_json,
    shown_on_terminal,
)

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(keys.app, name="key")
app.add_typer(data.app)
app.add_typer(loops.app)
app.add_typer(jobs.app)
app.add_typer(alarms.app)
app.add_typer(webhooks.app)
_HAND_OVER: dict[str, object] = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"loopwright {version('loopwright')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Retunes PI loops automatically over CANopen, and restores the loop whatever fails."""


def main() -> None:
    try:
        try:
            app()
        finally:
            print(end="", flush=True)
    except ApiError as error:
        print(f"loopwright: {error}", file=sys.stderr)
        sys.exit(error.status)
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            print(f"loopwright: {error}", file=sys.stderr)
        # Python writes at its end what is left of the output, which failed here where a disk is full.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in ("", "loopwright"):
            raise
        extra = "plot" if missing == "matplotlib" else "service"
        what = "plots need" if extra == "plot" else "this command needs"
        print(f"loopwright: {what} {missing}: pip install 'loopwright[{extra}]'", file=sys.stderr)
        sys.exit(2)


# The service imports these processes nowhere else: it reaches them over the bus only.
@app.command(context_settings=_HAND_OVER, add_help_option=False)
def plant(context: typer.Context) -> None:
    """Run a simulated plant on the bus (see plant --help)."""
    from loopwright.plantsim.__main__ import main as run
    from loopwright.service.cli.plant_model import with_own_plants

    sys.exit(run(with_own_plants(context.args)))


@app.command(context_settings=_HAND_OVER, add_help_option=False)
def controller(context: typer.Context) -> None:
    """Run a PI(D) controller on the bus (see controller --help)."""
    from loopwright.controller.__main__ import main as run

    sys.exit(run(context.args))


@app.command(context_settings=_HAND_OVER, add_help_option=False)
def hub(context: typer.Context) -> None:
    """Run a CAN bus on 127.0.0.1 for systems without SocketCAN (see hub --help)."""
    from loopwright.protocol.hub import main as run

    sys.exit(run(context.args))


@app.command()
def serve(
    loops: Annotated[Path, typer.Option(help="Configuration of the loops, YAML.")] = Path("loops.yaml"),
    data: Annotated[Path, typer.Option(help="Folder for jobs and samples.")] = Path("data"),
    bind: Annotated[str, typer.Option(help="Address to listen on; any but loopback needs keys.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on; 0: any free one.", min=0, max=65535)] = 8080,
    database: Annotated[
        str | None,
        typer.Option(envvar="LOOPWRIGHT_DATABASE", help="postgresql://..., shared by several hosts; default: a file."),
    ] = None,
    gateway: Annotated[
        str | None,
        typer.Option(envvar="LOOPWRIGHT_GATEWAY", help="Name of this gateway among those of a shared database."),
    ] = None,
    own_url: Annotated[
        str | None,
        typer.Option(
            "--own-url",
            metavar="URL",
            envvar="LOOPWRIGHT_OWN_URL",
            help="Where browsers reach this service; shown on the pages of the other gateways.",
        ),
    ] = None,
    node: Annotated[
        str,
        typer.Option(
            envvar="LOOPWRIGHT_NODE", help="CANopen node id of the service, unique among the gateways of a bus."
        ),
    ] = "0x7D",
    resume: Annotated[bool, typer.Option(help="Resume jobs that a crash interrupted.")] = True,
    auth: Annotated[
        bool | None, typer.Option("--auth/--no-auth", help="Require keys. Default: not if only this machine is served.")
    ] = None,
    max_body: Annotated[
        int, typer.Option(min=1024, envvar="LOOPWRIGHT_MAX_BODY", help="Maximum size of a request body, bytes.")
    ] = 1_048_576,
    rate: Annotated[
        float,
        typer.Option(
            min=0.1, envvar="LOOPWRIGHT_RATE", help="Maximum requests/s of one caller; twice that in a burst."
        ),
    ] = 500.0,
    at_once: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_AT_ONCE", help="Maximum requests answered at once, all callers.")
    ] = 64,
    streams: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_STREAMS", help="Maximum event streams open at once, all callers.")
    ] = 200,
    computations: Annotated[
        int,
        typer.Option(min=1, envvar="LOOPWRIGHT_COMPUTATIONS", help="Maximum tunings computed at once, all callers."),
    ] = 2,
    live_cpu_s: Annotated[
        int,
        typer.Option(
            min=1, envvar="LOOPWRIGHT_LIVE_CPU_S", help="Maximum CPU time of a computation for a live loop, s."
        ),
    ] = 120,
    tuning_cpu_s: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_TUNING_CPU_S", help="Maximum CPU time of a tuning, s.")
    ] = 60,
    dry_run_cpu_s: Annotated[
        int, typer.Option(min=1, envvar="LOOPWRIGHT_DRY_RUN_CPU_S", help="Maximum CPU time of a dry run, s.")
    ] = 300,
    computation_memory_mb: Annotated[
        int,
        typer.Option(min=16, envvar="LOOPWRIGHT_COMPUTATION_MEMORY_MB", help="Maximum memory of a computation, MB."),
    ] = 512,
    connections: Annotated[
        int,
        typer.Option(
            min=16, envvar="LOOPWRIGHT_CONNECTIONS", help="Maximum connections; half of them from one address."
        ),
    ] = 512,
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS[/NET]",
            envvar="LOOPWRIGHT_TRUSTED_PROXIES",
            help="Trust X-Forwarded-For of this proxy; may be repeated. Default: no proxy.",
        ),
    ] = None,
    keep_jobs: Annotated[
        int | None,
        typer.Option(
            min=1, envvar="LOOPWRIGHT_KEEP_JOBS", help="Number of jobs per loop whose samples are kept; default: all."
        ),
    ] = None,
    keep_days: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=36_500, envvar="LOOPWRIGHT_KEEP_DAYS", help="Days that samples are kept; default: for ever."
        ),
    ] = None,
    listen: Annotated[
        bool, typer.Option(envvar="LOOPWRIGHT_LISTEN", help="Hear the process data of all loops, and keep the history.")
    ] = True,
    keep_history_days: Annotated[
        float,
        typer.Option(
            min=0.0, max=36_500, envvar="LOOPWRIGHT_KEEP_HISTORY_DAYS", help="Days that stored history is kept."
        ),
    ] = 7.0,
    log_format: Annotated[
        str, typer.Option(envvar="LOOPWRIGHT_LOG_FORMAT", help="text, or json with one object per line.")
    ] = "text",
) -> None:
    """Run the service: a REST API over jobs that retune live loops."""
    from argparse import ArgumentTypeError
    from ipaddress import ip_network

    from loopwright.service.server.loading import loading

    with loading():
        from sqlalchemy.exc import SQLAlchemyError

        from loopwright.protocol.device_process import node_id
        from loopwright.service.api.gate.limits import RequestLimits
        from loopwright.service.cli import site_table
        from loopwright.service.execution.computing.limits import ComputingLimits
        from loopwright.service.inputs.config import ConfigError, load_site
        from loopwright.service.inputs.webhooks import BadSecret
        from loopwright.service.jobs.retention import RetentionPolicy
        from loopwright.service.server.serving import NotSafe, Setup
        from loopwright.service.server.serving import serve as run
        from loopwright.service.store.database import BadDatabase
        from loopwright.service.store.lock import FolderInUse
        from loopwright.service.store.store import ForeignLoop

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
    if own_url is not None and not re.fullmatch(r"https?://[^\s/?#\"'<>]+/?", own_url):
        die(f"--own-url takes https://HOST or https://HOST:PORT, or http, not {own_url!r}", 2)
    try:
        own_node = node_id(node)
    except (ValueError, ArgumentTypeError):
        die(f"--node must be a CANopen node id, 1 to 127 (0x01 to 0x7F), not {node!r}", 2)
    setup = Setup(
        loops, data, bind, port, database, gateway, resume,
        node=own_node, auth=auth, limits=limits, log_format="json" if log_format == "json" else "text",
        keep=RetentionPolicy(keep_jobs, keep_days, keep_history_days), trusted_proxies=proxies, listen=listen,
        url=None if own_url is None else own_url.rstrip("/"),
        computing=ComputingLimits(live_cpu_s, tuning_cpu_s, dry_run_cpu_s, computation_memory_mb),
    )  # fmt: skip
    try:
        if shown_on_terminal():
            site_table.show(list(load_site(loops).loops.values()))
        run(setup)
    except (ConfigError, BadSecret, FolderInUse, ForeignLoop, BadDatabase, NotSafe) as error:
        die(str(error), 2)
    except SQLAlchemyError as error:
        die(f"the database cannot be used: {getattr(error, 'orig', None) or error}", 2)
    except OSError as error:
        if data.exists() and not data.is_dir():
            die(f"cannot write to {data}: it is a file, --data takes a folder", 2)
        if error.errno == errno.EADDRINUSE:
            die(f"cannot listen on {bind}:{port}, which another program uses: choose another port with --port", 2)
        die(f"cannot listen on {bind}:{port} or write to {data}: {error.strerror or error}", 2)


@app.command("loops")
def list_loops(url: Url = DEFAULT_URL, as_json: AsJson = False) -> None:
    """List the configured loops."""
    from loopwright.service.api.job_views import LoopView
    from loopwright.service.cli import job_tables, terminal

    found = Client(url).pages("/loops")
    if as_json:
        print_json(found)
        return
    loops = parsed(list[LoopView], found)
    shown = ("tag", "description", "bus", "controller_node", "pv_unit", "t95_s", "active_job")
    terminal.rows(
        "loops",
        ("tag", "description", "bus", "node", "unit", "T95 s", "job", "locked"),
        ((*(getattr(each, name) for name in shown), job_tables.lock(each.locked)) for each in loops),
    )


@app.command()
def retune(
    loop: Annotated[str, typer.Argument(help="Tag of the loop; with * or ? every loop whose tag matches.")],
    preview: Annotated[
        bool, typer.Option("--preview", help="Only show what the retune would do; nothing is moved.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Start without asking.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Rehearse in memory; the loop is not touched.")] = False,
    sp_deviation: Annotated[float | None, typer.Option(help="Permitted set-point step, PV units.")] = None,
    mv_low: Annotated[float | None, typer.Option(help="Lowest MV during the test, percent.")] = None,
    mv_high: Annotated[float | None, typer.Option(help="Highest MV during the test, percent.")] = None,
    directions: Annotated[str | None, typer.Option(help="To where the set-point is moved: both, up or down.")] = None,
    sp_rate_max: Annotated[
        float | None, typer.Option("--sp-rate-max-per-s", help="Largest rate of the set-point, PV units per s.")
    ] = None,
    method: Annotated[str | None, typer.Option(help="fast, setpoint, five-stage or a rule; default: fast.")] = None,
    ms: Annotated[float | None, typer.Option(help="Ms that is designed for: 1.2 robust .. 1.6 .. 2.0 fast.")] = None,
    derivative: Annotated[
        bool, typer.Option("--derivative", help="Design a PID where it is better than a PI.")
    ] = False,
    aim: AskedAim = None,
    settling_s: AskedSettling = None,
    mv_peak: AskedMvPeak = None,
    noise_gain: AskedNoiseGain = None,
    setpoint_weight_max: AskedWeight = None,
    amplitude: Annotated[float | None, typer.Option(help="Relay amplitude for fast, percent of MV.")] = None,
    excitations: Annotated[
        str | None, typer.Option(help="What fast moves the loop by, of what loops.yaml permits: setpoint,relay,manual.")
    ] = None,
    min_switches: Annotated[
        int | None, typer.Option(help="Smallest number of switches of the relay of fast: 4, 6, 8 or 10.")
    ] = None,
    verify: Annotated[bool, typer.Option(help="Make the set-point step under the new gains.")] = True,
    propose_anyway: Annotated[
        bool,
        typer.Option(
            "--propose-anyway", help="Propose the gains also where nothing asked for improves by more than 5 %."
        ),
    ] = False,
    from_job: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="JOB",
            help="Try other gains for the model that this job found, by --ms or --method, without another experiment.",
        ),
    ] = None,
    wait: Annotated[bool, typer.Option(help="Show the progress until the job is over.")] = True,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Retune a loop, with live progress. Exit status 0: proposed, rehearsed or no_gain; 3: any other end, or --preview
    shows an obstacle."""
    many = any(character in loop for character in "*?")
    if not (preview or yes or dry_run or on_terminal()):
        die("a retune moves the process: see the preview with --preview, and start it with --yes", 2)
    client = Client(url)
    options: dict[str, object] = {
        "sp_deviation": sp_deviation, "mv_low": mv_low, "mv_high": mv_high, "dry_run": dry_run or None,
        "directions": directions, "sp_rate_max_per_s": sp_rate_max,
        "method": method, "Ms": ms, "derivative": derivative or None, "aim": aim, "settling_s": settling_s,
        "mv_peak": mv_peak, "noise_gain": noise_gain, "setpoint_weight_max": setpoint_weight_max,
        "amplitude_pct": amplitude,
        "excitations": excitations.split(",") if excitations else None,
        "min_switches": min_switches, "verify": None if verify else False, "propose_anyway": propose_anyway or None,
        "pattern": loop if many else None,
    }  # fmt: skip
    body = {name: value for name, value in options.items() if value is not None} | {"by": "cli"}
    path = "/batches" if many else f"/loops/{loop}/retune"
    if from_job is not None:
        if many:
            die("--from takes one loop, not a pattern", 2)
        asked = 1.6 if ms is None and method is None else ms
        wanted = {
            "aim": aim, "settling_s": settling_s, "mv_peak": mv_peak, "noise_gain": noise_gain,
            "setpoint_weight_max": setpoint_weight_max,
        }  # fmt: skip
        body |= _other_gains(client, from_job, loop, method, asked, derivative, wanted)
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


def _other_gains(
    client: Client,
    job: str,
    loop: str,
    method: str | None,
    ms: float | None,
    derivative: bool,
    options: Mapping[str, str | float | None],
) -> dict[str, object]:
    """Returns the request that tries other gains for the model of a job. Ends the command where there are none."""
    from loopwright.service.api.tuning_views import AlternativesView

    wanted = str(derivative).lower() if ms is not None else None
    path = f"{jobs.path_of(client, job)}/alternatives"
    answer = client.computed(path, Ms=ms, derivative=wanted, method=method, **options)
    found = parsed(AlternativesView, answer)
    if found.loop != loop:
        die(f"job {found.job} is of loop {found.loop}, not of {loop}", 2)
    (each,) = found.methods
    if each.retune is None:
        die(f"{each.title}: {each.detail or 'its gains are not robust enough to be tried'}. {each.advice or ''}", 3)
    return dict(each.retune)


def _previewed(
    client: Client, path: str, body: dict[str, object], *, alone: bool = False, as_json: bool = False
) -> bool:
    """Shows the preview; returns whether the retune would start.

    alone: False where a question follows; the preview is then on standard error, and standard output is for the report.
    """
    from loopwright.service.cli import preview_tables, terminal
    from loopwright.service.planning.preview import FleetPreview, Preview

    answer = client.post(f"{path}/preview", body)
    many = "pattern" in body
    found = parsed(FleetPreview, answer) if many else parsed(Preview, answer)
    if as_json:
        print_json(answer)
    else:
        preview_tables.show(found, terminal.console if alone else terminal.progress_console)
    return found.would_start == (found.count if isinstance(found, FleetPreview) else True)


def _one(client: Client, started: object, wait: bool, as_json: bool) -> int:
    """Follows the job that was started; returns the exit status."""
    from loopwright.service.api.job_views import JobView
    from loopwright.service.cli import job_tables
    from loopwright.service.states.job_state import GOOD

    job = parsed(JobView, started)
    if wait:
        print(f"job {job.id} of {job.loop}", file=sys.stderr)
        with job_going_on(job.id):
            if as_json:
                for _ in client.events(job.url):
                    pass
                job = parsed(JobView, client.awaited(job.url))
            else:
                job = job_tables.follow(client, job.url)
    if as_json:
        print_json(job.model_dump(mode="json"))
    else:
        job_tables.job_report(job, jobs.unit_of(client, job.loop))
    return 3 if wait and job.state not in GOOD else 0


def _many(client: Client, started: object, wait: bool, as_json: bool) -> int:
    """Follows the batch that was started; returns the exit status."""
    from loopwright.service.cli import fleet_tables
    from loopwright.service.cli.answers import BatchShown
    from loopwright.service.states.job_state import GOOD

    answer, found = started, parsed(BatchShown, started)
    if wait:
        print(f"batch {found.id} of {len(found.loops)} loops", file=sys.stderr)
        ends = f"end it with: POST {client.url}{found.url}/abort"
        with going_on(f"batch {found.id}", f"see it with: loopwright batches, its jobs with: loopwright jobs, {ends}"):
            answer = fleet_tables.follow(client, found.url, quiet=as_json)
        found = parsed(BatchShown, answer)
    if as_json:
        print_json(answer)
    else:
        fleet_tables.report(found)
    return 3 if wait and any(each.state not in GOOD for each in found.loops) else 0


@app.command()
def acknowledge(
    loop: Annotated[str, typer.Argument(help="Tag of the loop.")], url: Url = DEFAULT_URL, as_json: AsJson = False
) -> None:
    """Answer for a loop whose restoration after a job was not confirmed, or whose PV a test has found to be false."""
    from loopwright.service.api.job_views import AcknowledgedView

    answer = Client(url).post(f"/loops/{loop}/acknowledge", {"by": "cli"})
    if as_json:
        print_json(answer)
        return
    jobs = parsed(AcknowledgedView, answer).jobs
    if jobs:
        print(f"{loop}: you answer for it now; its restoration is not looked for any more, and a test may begin.")
        print(f"Acknowledged: {', '.join(jobs)}")
    else:
        print(f"{loop}: there was nothing to acknowledge. Its restoration was confirmed, and no test found PV false.")


app.command("methods")(tuning.methods)
app.command("tune")(tuning.tune)
app.command("identify")(identification.identify)
app.command("rehearse")(rehearse.rehearse)


@app.command()
def demo(
    folder: Annotated[
        Path | None, typer.Option(help="Folder for plots and data; default: a new temporary folder.")
    ] = None,
    speed: Annotated[
        str, typer.Option(help="Speed of the plant: a factor of real time, or max, which is real time after the table.")
    ] = "max",
    hub_only: Annotated[
        bool, typer.Option("--hub", help="Use the loopback hub even if there is a vcan0 interface.")
    ] = False,
    method: Annotated[
        Literal["five-stage", "fast", "setpoint"] | None,
        typer.Option(help="One of them alone; default: all, one after the other."),
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="End after the table, as without a terminal, instead of serving the page.")
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(help="Port of the page; default: 8080 if it is free, else any free one.", min=0, max=65535),
    ] = None,
) -> None:
    """Run a demo that retunes a badly tuned loop, with bus, plant, controller and service as processes.

    In a terminal it goes on after its table, with the loop on the page, until Ctrl-C.
    """
    from loopwright.service.cli.demo import DemoFailed, DemoOptions, run_demo
    from loopwright.service.cli.demo_report import METHODS
    from loopwright.service.cli.interruption import Interrupted

    goes_on = not once and on_terminal() and shown_on_terminal()
    try:
        run_demo(DemoOptions([method] if method else METHODS, speed, hub_only, goes_on, folder, port))
    except DemoFailed as error:
        die(str(error), 1)
    except Interrupted as error:
        die(f"{error}: the demo is not through; its processes are stopped", 128 + error.number)
