"""`loopwright demo`: retunes a badly tuned loop by each method, over a real bus, by real processes, through HTTP."""

from __future__ import annotations

import shutil
import socket
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import yaml

from loopwright.protocol.tuner import TunerError
from loopwright.service.cli import demo_live, terminal
from loopwright.service.cli.child_process import ChildProcess, NotReady
from loopwright.service.cli.client import ApiError, Client
from loopwright.service.cli.demo_report import METHODS, PLANT, PLANT_MODEL, Demonstration, demonstrate, report
from loopwright.service.cli.interruption import Interrupted, Interruption
from loopwright.service.cli.plots.job import NoPicture, job_picture

TAG = "TIC-101"
PV_UNIT = "degC"
SAMPLE_TIME_S = 0.02
"""A 150th of model 14's ultimate period, 3.3 s."""
NOISE = "0.002"
"""Standard deviation of the noise of PV, degC: 1 % of the PV amplitude under the relay."""
BAD_GAINS = ("80", "1.2")
"""Kp in % per PV unit, Ti in s: model 14 (Ku 205, Pu 3.3 s) oscillates for a long time with these gains."""

ADDRESS = "127.0.0.1"
"""The page is for this machine alone: the demo has no keys, and who reaches it may move its loop."""
PAGE_PORT = 8080
"""The default port of `loopwright serve` and of the commands that ask it, which then need no --url."""
_LOOK_S = 0.5
"""Wall time between two looks at the processes of a demo that goes on, s."""


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


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """How the demo runs.

    methods: those that retune the loop, one after the other.
    speed: of the plant during these retunes, "max" or a factor of real time.
    hub_only: whether the loopback hub is the bus even if there is a vcan0.
    goes_on: whether the loop stays in operation after the table, with its page, until a signal comes.
    folder: for pictures and data; None: a new temporary one, which is removed at the end of a demo that goes on.
    port: of the page on 127.0.0.1; None: 8080 if the demo goes on and it is free, else any free one.
    """

    methods: Sequence[str] = METHODS
    speed: str = "max"
    hub_only: bool = False
    goes_on: bool = False
    folder: Path | None = None
    port: int | None = None


def run_demo(options: DemoOptions) -> None:
    """Runs the demo from the bus to the plots and, where it goes on, until SIGINT, SIGTERM or SIGHUP. Whatever ends it,
    every process that it started is stopped.

    Raises DemoFailed, and Interrupted for a signal before the demo is through.
    """
    port = port_of(options)
    with Interruption() as interruption:
        demo = _Demo(options, interruption)
        try:
            with demo.files, demo.devices, demo.served:
                try:
                    demo.run(port)
                finally:
                    interruption.ignore()
        except Interrupted:
            if demo.shown is None:
                raise
    if demo.shown is not None and demo.shown.without_proposal:
        raise DemoFailed(f"not every retune ended as a proposal: {', '.join(demo.shown.without_proposal)}")


def port_of(options: DemoOptions) -> int:
    """Returns the port for the service, 0 for any free one. Raises DemoFailed for one that was named and is taken."""
    wanted = (PAGE_PORT if options.goes_on else 0) if options.port is None else options.port
    try:
        socket.create_server((ADDRESS, wanted)).close()
    except OSError as error:
        why = f"port {wanted} of {ADDRESS} cannot be used ({error.strerror})"
        if options.port is not None:
            raise DemoFailed(f"{why}: name another with --port, or leave it out for any free one") from error
        _say(f"port       {why}: the page gets a free one")
        return 0
    return wanted


class _Demo:
    """One run of the demo: its processes and its files.

    served: ends the service, before `devices` ends the others: the service restores its loop first.
    files: removes the temporary folder at the end, unless something in it is still wanted.
    shown: the retunes, once all of them are over and shown.
    """

    def __init__(self, options: DemoOptions, interruption: Interruption) -> None:
        self._options, self._interruption = options, interruption
        self.files, self.devices, self.served = ExitStack(), ExitStack(), ExitStack()
        self._processes: list[ChildProcess] = []
        self.shown: Demonstration | None = None

    def run(self, port: int) -> None:
        """Runs the demo to its end; one that goes on ends by Interrupted alone, or when one of its processes ends.

        port: for the service.
        Raises DemoFailed, Interrupted.
        """
        options = self._options
        with self._interruption.held():
            folder = self._made_folder()
        try:
            client = self._start(folder, port)
            shown = demonstrate(client, TAG, options.methods)
            report(client, TAG, shown, PLANT_MODEL)
            for job in shown.jobs:
                job_picture(folder / f"{job.method}.png", client.samples_of(job.url), job, PV_UNIT)
        except (NotReady, ApiError, NoPicture) as error:
            raise DemoFailed(f"{error}\n(logs are in {folder})") from error
        _say(f"pictures         {', '.join(str(folder / f'{job.method}.png') for job in shown.jobs)}")
        _say(f"jobs, samples    {folder / 'data' / 'loopwright.sqlite'}")
        _say(f"configuration    {folder / 'loops.yaml'}")
        _say("next             docs/rest.md: the same by hand; docs/jobs.md: how it works")
        self.shown = shown
        if options.goes_on:
            self._go_on(client.url, shown, folder)

    def _made_folder(self) -> Path:
        wanted = self._options.folder
        if wanted is None:
            made = Path(tempfile.mkdtemp(prefix="loopwright-demo-"))
            self.files.push(partial(self._remove, made))
            return made
        wanted.mkdir(parents=True, exist_ok=True)
        return wanted

    def _remove(self, folder: Path, kind: type[BaseException] | None, *_: object) -> None:
        """Removes the folder, unless it was printed by a demo that is over, or has the logs of one that failed."""
        interrupted = kind is not None and issubclass(kind, Interrupted)
        if interrupted or (kind is None and self._options.goes_on):
            shutil.rmtree(folder, ignore_errors=True)

    def _start(self, folder: Path, port: int) -> Client:
        if not self._options.hub_only and vcan_usable():
            self.bus = "socketcan:vcan0"
            _say("bus        vcan0")
        else:
            self.bus = self._process(self.devices, folder, "hub", "loopwright.protocol.hub", "--port", "0").split()[1]
        bus, ts = self.bus, str(SAMPLE_TIME_S)
        kp, ti = BAD_GAINS
        tuning = ("--kp", kp, "--ti", ti, "--sp", "50", "--ts", ts)
        controller = ("loopwright.controller", "--bus", bus, "--channels", "1", *tuning)
        self._process(self.devices, folder, "controller", *controller)
        loops = folder / "loops.yaml"
        loops.write_text(loops_yaml(bus), encoding="utf-8")
        kept = ("--data", str(folder / "data"))
        serve = ("loopwright.service", "serve", "--loops", str(loops), *kept, "--bind", ADDRESS, "--port", str(port))
        url = self._process(self.served, folder, "service", *serve).split()[1]
        # The plant starts last, because at full speed it takes all the processor time that is left.
        runs = ("--model", PLANT, "--ts", ts, "--speed", self._options.speed, "--noise", NOISE)
        self._process(self.devices, folder, "plant", "loopwright.plantsim", "--bus", bus, *runs)
        return Client(url)

    def _process(self, stack: ExitStack, folder: Path, name: str, *arguments: str) -> str:
        with self._interruption.held():
            # Ctrl-C is for this process, which ends the others in their order.
            started = ChildProcess(name, arguments, folder / f"{name}.log", own_group=True)
            stack.callback(started.stop)
        self._processes.append(started)
        line = started.wait_ready()
        _say(f"{name:<11}{' '.join(arguments)}")
        return line

    def _go_on(self, url: str, shown: Demonstration, folder: Path) -> None:
        """Names the page, and returns never: Interrupted is raised, or DemoFailed when a process ends by itself."""
        if self._options.speed == "max":
            try:
                demo_live.set_pace(self.bus, demo_live.REAL_TIME)
            except (TunerError, OSError) as error:
                raise DemoFailed(f"the plant cannot be set to real time: {error}\n(logs are in {folder})") from error
        port = url.rpartition(":")[2]
        elsewhere = f"on this machine; from another one: ssh -L {port}:{ADDRESS}:{port} {socket.gethostname()}"
        _say(demo_live.page_line(url, TAG, elsewhere))
        if (proposal := demo_live.latest_proposal(shown.jobs)) is not None:
            _say(demo_live.accept_line(demo_live.accept_command(url, proposal.id), proposal))
        removed = "" if self._options.folder else f", and removes {folder} (--folder keeps the files)"
        _say(f"end              Ctrl-C ends the demo{removed}")
        try:
            while True:
                for process in self._processes:
                    if process.poll() is not None:
                        raise DemoFailed(f"the {process.name} ended: {process.last_lines()}\n(logs are in {folder})")
                time.sleep(_LOOK_S)
        except Interrupted:
            self._interruption.ignore()
            _say("\nending           the service, which restores its loop first; then the other processes")
            raise


def _say(line: str) -> None:
    terminal.console.print(line, highlight=False, soft_wrap=True)
