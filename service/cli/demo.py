"""`loopwright demo`: retunes a badly tuned loop by each method, over a real bus, by real processes, through HTTP."""

from __future__ import annotations

import socket
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import yaml

from loopwright.service.cli import job_tables
from loopwright.service.cli.child_process import ChildProcess, NotReady
from loopwright.service.cli.client import ApiError, Client
from loopwright.service.cli.demo_report import PLANT, PLANT_MODEL, demonstrate, report
from loopwright.service.plots.job import NoPicture, job_picture

TAG = "TIC-101"
PV_UNIT = "degC"
SAMPLE_TIME_S = 0.02
"""A 150th of model 14's ultimate period, 3.3 s."""
NOISE = "0.002"
"""Standard deviation of the noise of PV, degC: 1 % of the PV amplitude under the relay."""
BAD_GAINS = ("80", "1.2")
"""Kp in % per PV unit, Ti in s: model 14 (Ku 205, Pu 3.3 s) oscillates for a long time with these gains."""


class DemoFailed(Exception):
    """The demo failed; the text is for the person who runs it."""


def vcan_usable(name: str = "vcan0") -> bool:
    """Returns whether there is a CAN interface of that name that a socket can send on."""
    if not hasattr(socket, "AF_CAN"):
        return False
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((name,))
            probe.send(b"\x7f\x07\x00\x00\x01\x00\x00\x00\x05" + bytes(7))  # heartbeat of a node 127: harmless
    except OSError:
        return False
    return True


def loops_yaml(bus: str) -> str:
    """Returns the configuration of the demo's loop."""
    loop: dict[str, object] = {
        "tag": TAG,
        "description": "Model 14 with gains that make it oscillate",
        "bus": bus,
        "controller_node": 0x20,
        "plant_node": 0x10,
        "channel": 1,
        "pv_unit": PV_UNIT,
        "mv_limits": {"low": 0.0, "high": 100.0},
        "pv_limits": {"low": 49.0, "high": 51.0},
        "t95_s": 9.1,
        "sp_deviation": 0.1,
        "notes": "PV 50 at MV 50 %; 100 % of MV move PV by 2 degC",
    }
    return str(yaml.safe_dump({"loops": [loop]}, sort_keys=False))


def run_demo(folder: Path | None, speed: str, hub_only: bool, methods: Sequence[str]) -> None:
    """Runs the demo from the bus to the plots, and stops every process that it started. Raises DemoFailed."""
    target = folder or Path(tempfile.mkdtemp(prefix="loopwright-demo-"))
    target.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            client = _start(stack, target, speed, hub_only)
            shown = demonstrate(client, TAG, methods)
            report(client, TAG, shown, PLANT_MODEL)
            for job in shown.jobs:
                job_picture(target / f"{job.method}.png", client.samples_of(job.url), job, PV_UNIT)
        except (NotReady, ApiError, NoPicture) as error:
            raise DemoFailed(f"{error}\n(logs are in {target})") from error
    lines = [
        f"pictures         {', '.join(str(target / f'{job.method}.png') for job in shown.jobs)}",
        f"jobs, samples    {target / 'data' / 'loopwright.sqlite'}",
        f"configuration    {target / 'loops.yaml'}",
        "next             docs/rest.md: the same by hand; docs/one-job.md: how it works",
    ]
    job_tables.console.print("\n".join(lines), highlight=False, soft_wrap=True)
    if shown.without_proposal:
        raise DemoFailed(f"not every retune ended as a proposal: {', '.join(shown.without_proposal)}")


def _start(stack: ExitStack, folder: Path, speed: str, hub_only: bool) -> Client:
    def process(name: str, *arguments: str) -> str:
        started = ChildProcess(name, arguments, folder / f"{name}.log")
        stack.callback(started.stop)
        line = started.wait_ready()
        job_tables.console.print(f"{name:<11}{' '.join(arguments)}", highlight=False, soft_wrap=True)
        return line

    if not hub_only and vcan_usable():
        bus = "socketcan:vcan0"
        job_tables.console.print("bus        vcan0")
    else:
        bus = process("hub", "loopwright.protocol.hub", "--port", "0").split()[1]
    ts = str(SAMPLE_TIME_S)
    plant = ["--bus", bus, "--model", PLANT, "--ts", ts, "--speed", speed, "--noise", NOISE]
    kp, ti = BAD_GAINS
    # The plant starts last, because at full speed it takes all the processor time that is left.
    tuning = ["--kp", kp, "--ti", ti, "--sp", "50", "--ts", ts]
    process("controller", "loopwright.controller", "--bus", bus, "--channels", "1", *tuning)
    loops = folder / "loops.yaml"
    loops.write_text(loops_yaml(bus), encoding="utf-8")
    serve = ("loopwright.service", "serve", "--loops", str(loops), "--data", str(folder / "data"), "--port", "0")
    url = process("service", *serve).split()[1]
    process("plant", "loopwright.plantsim", *plant)
    return Client(url)
