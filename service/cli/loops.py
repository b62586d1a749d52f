"""`loopwright check`, `probe`, `loop`, `observe`, `lock` and `unlock`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated
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
    print_json,
    user,
)

app = typer.Typer()

Tag = Annotated[str, typer.Argument(help="Tag of the loop.")]


@app.command()
def check(
    loops: Annotated[Path, typer.Argument(metavar="LOOPS.yaml", help="Configuration of the loops.")] = Path(
        "loops.yaml"
    ),
    as_json: AsJson = False,
) -> None:
    """Read every loop of a configuration over its bus, without the service; nothing is written to any device.

    Exit status 0: every loop answers as configured; 2: the file cannot be used; 3: a loop does not answer so.
    """
    from loopwright.protocol.station import Station
    from loopwright.service.cli import check_tables
    from loopwright.service.inputs.config import ConfigError, load_site
    from loopwright.service.loops.bus_check import check_loop

    try:
        configured = list(load_site(loops).loops.values())
    except ConfigError as error:
        die(str(error), 2)
    station = Station()
    found = [(config, check_loop(config, station)) for config in configured]
    if as_json:
        print_json([check_tables.as_json(config, each) for config, each in found])
    else:
        check_tables.show(found)
    if any(each.problem for _, each in found):
        raise typer.Exit(3)


@app.command()
def probe(
    bus: Annotated[str, typer.Option(metavar="URL", help="socketcan:can0, socketcand:HOST:PORT, ...")],
    node: Annotated[
        list[str] | None, typer.Option(help="A node to ask also that sends no heartbeat; may be repeated.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what is on a bus: the nodes, what they are, and what prevents a retune with them. Nothing is written.

    Exit status 0: a controller was found and nothing is wrong; 3: otherwise.
    """
    from argparse import ArgumentTypeError

    from loopwright.protocol.device_process import node_id
    from loopwright.protocol.objects import Device
    from loopwright.protocol.station import Station
    from loopwright.service.cli import check_tables
    from loopwright.service.loops import bus_probe
    from loopwright.tuning.reasons import Failed

    try:
        asked = [node_id(each) for each in node or ()]
    except (ValueError, ArgumentTypeError):
        die(f"--node must be a CANopen node id, 1 to 127 (0x01 to 0x7F), not {', '.join(node or ())}", 2)
    try:
        found = bus_probe.probe(bus, Station(), asked)
    except Failed as error:
        die(f"{error.detail}. {error.advice}", 1)
    if as_json:
        print_json([check_tables.node_as_json(each) for each in found])
    else:
        check_tables.show_nodes(bus, found)
    if any(each.problems for each in found) or not any(each.device is Device.CONTROLLER for each in found):
        raise typer.Exit(3)


@app.command("loop")
def one_loop(
    tag: Tag,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Show it live, about once a second, until Ctrl-C.")
    ] = False,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Show a loop and its present state."""
    from loopwright.service.api.job_views import LoopDetail
    from loopwright.service.cli import job_tables

    client = Client(url)
    if follow:
        from loopwright.service.cli import jobs, loop_live
        from loopwright.service.cli.terminal import console

        loop_live.follow(client, tag, jobs.unit_of(client, tag), console, as_json)
        return
    found = client.get(f"/loops/{quote(tag, safe='')}")
    if as_json:
        print_json(found)
    else:
        job_tables.loop_report(parsed(LoopDetail, found))


@app.command()
def observe(
    tag: Tag,
    ms: Annotated[float, typer.Option(help="Ms that is designed for: 1.2 robust .. 1.6 .. 2.0 fast.")] = 1.6,
    derivative: Annotated[
        bool, typer.Option("--derivative", help="Design a PID where it is better than a PI.")
    ] = False,
    aim: AskedAim = None,
    settling_s: AskedSettling = None,
    mv_peak: AskedMvPeak = None,
    noise_gain: AskedNoiseGain = None,
    setpoint_weight_max: AskedWeight = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Show what the set-point changes in the history of a loop tell of its gains. Nothing is moved or written on it.

    Exit status 0: gains are proposed; 3: they are not, and why is said.
    """
    from loopwright.service.observing.observed import ObservationState, ObservationView

    path = f"/loops/{quote(tag, safe='')}/observation"
    found = Client(url).computed(
        path, Ms=ms, derivative=str(derivative).lower(), aim=aim, settling_s=settling_s, mv_peak=mv_peak,
        noise_gain=noise_gain, setpoint_weight_max=setpoint_weight_max,
    )  # fmt: skip
    shown = parsed(ObservationView, found)
    if as_json:
        print_json(found)
    else:
        from loopwright.service.cli import observation_tables
        from loopwright.service.cli.terminal import console

        observation_tables.show(shown, console)
    if shown.state is not ObservationState.PROPOSAL:
        raise typer.Exit(3)


@app.command()
def lock(
    tag: Tag,
    reason: Annotated[str, typer.Option(help="Reason, shown to everyone whose test is refused.")],
    by: Annotated[
        str | None, typer.Option(help="Name of the person who locks the loop; default: the user logged in.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Lock a loop: until it is unlocked no test begins on it, and no decision writes to it."""
    from loopwright.service.cli.answers import LockAnswer

    answer = Client(url).post(f"/loops/{quote(tag, safe='')}/lock", {"reason": reason, "by": by or user()})
    if as_json:
        print_json(answer)
        return
    found = parsed(LockAnswer, answer)
    print(f"{tag} is locked by {found.locked.by} since {found.locked.since}: {found.locked.reason}")
    if found.note:
        print(found.note)


@app.command()
def unlock(
    tag: Tag,
    by: Annotated[
        str | None, typer.Option(help="Name of the person who unlocks the loop; default: the user logged in.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Unlock a loop."""
    from loopwright.service.cli.answers import UnlockAnswer

    answer = Client(url).post(f"/loops/{quote(tag, safe='')}/unlock", {"by": by or user()})
    if as_json:
        print_json(answer)
        return
    was = parsed(UnlockAnswer, answer).was_locked
    print(f"{tag} was not locked" if was is None else f"{tag} is unlocked; it was locked by {was.by}: {was.reason}")
