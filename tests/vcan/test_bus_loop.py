"""The live loop against real processes on a real (virtual) CAN bus, and over the hub."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence

import pytest

from loopwright.protocol.bus import open_bus
from loopwright.protocol.profile import COMMAND_FRAME, channel_ids
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import run
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, Plan, Sample, SetGains, SetMode, SetOutput, SetRelay, SetSetpoint
from loopwright.tuning.reasons import Ended, Failed, Reason, Refused

CONTROLLER, PLANT = 0x20, 0x10
GAINS = Gains(Kp=60.0, Ti=7.0)
TRIED = Gains(Kp=80.0, Ti=6.0)
LIMITS = RunLimits()

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `python -m MODULE ARGUMENTS` and waits until it says that it is ready."""
    started: list[subprocess.Popen[str]] = []

    def go(module: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", module, *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("ready"), f"{module} said {line!r}"
        process.ready = line.split()[-1]  # type: ignore[attr-defined]
        return process

    yield go
    for process in reversed(started):
        with process:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()


VCAN = pytest.param("vcan", marks=pytest.mark.vcan)


@pytest.fixture(params=[VCAN, "hub"])
def url(request: pytest.FixtureRequest, start: Start) -> str:
    if request.param == "hub":
        return str(start("loopwright.protocol.hub", "--port", "0").ready)  # type: ignore[attr-defined]
    return "socketcan:vcan0"


on_vcan = pytest.mark.parametrize("url", [VCAN], indirect=True)


def start_loop(start: Start, url: str, speed: str = "max") -> dict[str, subprocess.Popen[str]]:
    controller = start(
        "loopwright.controller",
        "--bus",
        url,
        "--channels",
        "1",
        "--kp",
        str(GAINS.Kp),
        "--ti",
        str(GAINS.Ti),
        "--sp",
        "50",
    )
    plant = start(
        "loopwright.plantsim", "--bus", url, "--model", "model-1", "--ts", "0.1", "--speed", speed, "--seed", "7"
    )
    return {"controller": controller, "plant": plant}


@pytest.fixture
def devices(start: Start, url: str) -> dict[str, subprocess.Popen[str]]:
    return start_loop(start, url)


@pytest.fixture
def loop(devices: object, url: str) -> Iterator[BusLoop]:
    loop = BusLoop(url, CONTROLLER, PLANT)
    yield loop
    loop.close()


def as_configured(state: LoopState) -> bool:
    return (state.mode, state.sp, state.on_trial) == (Mode.AUTOMATIC, 50.0, False) and state.gains == GAINS


def wait(samples: int) -> Plan[Sample]:
    sample = yield ()
    for _ in range(samples - 1):
        sample = yield ()
    return sample


def tiny_plan() -> Plan[list[Sample]]:
    """Every command once; the samples after each."""
    seen: list[Sample] = []

    def after(*commands: SetMode | SetGains | SetSetpoint | SetOutput | SetRelay) -> Plan[None]:
        seen.append((yield commands))
        for _ in range(30):
            seen.append((yield ()))

    yield from wait(20)
    yield from after(SetGains(TRIED))
    yield from after(SetSetpoint(50.25))
    yield from after(SetMode(Mode.MANUAL))
    yield from after(SetOutput(55.0))
    yield from after(SetMode(Mode.AUTOMATIC))
    biased = SetRelay(amplitude=10.0, hysteresis=0.0, working_output=50.0, amplitude_low=5.0, average=3)
    yield from after(biased, SetMode(Mode.EXPERIMENT))
    return seen


def test_a_plan_of_every_command_runs_and_leaves_the_loop_as_it_was(loop: BusLoop) -> None:
    before = loop.read()
    assert as_configured(before), before
    result = run(tiny_plan(), loop, limits=LIMITS)
    assert result.ended is None
    assert result.value is not None
    stages = [result.value[k : k + 31] for k in range(0, len(result.value), 31)]
    ends = [stage[-1] for stage in stages]
    assert [end.sp for end in ends] == [50, 50.25, 50.25, 50.25, 50.25, 50.25]
    assert [end.mode for end in ends] == [2, 2, 1, 1, 2, 3]
    assert ends[3].mv == 55.0
    assert {sample.mv for sample in stages[5][15:]} <= {45.0, 60.0}
    steps = {round(b.t - a.t, 6) for a, b in zip(result.value, result.value[1:], strict=False)}
    assert steps == {0.1}, "no sample is missing"
    assert result.restored is not None
    assert as_configured(result.restored), result.restored
    assert as_configured(loop.read())


@on_vcan
def test_equal_seeds_give_equal_runs(start: Start, url: str) -> None:
    runs = []
    for _ in range(2):
        processes = start_loop(start, url)
        loop = BusLoop(url, CONTROLLER, PLANT)
        runs.append(run(tiny_plan(), loop, limits=LIMITS).value)
        loop.close()
        for process in processes.values():
            process.terminate()
            process.wait(5)
    first, second = runs
    assert first is not None
    assert second is not None
    # The runs begin wherever the free-running plant was; from the first command on the loop is at rest in both.
    assert [s.mode for s in first] == [s.mode for s in second]
    assert [s.pv for s in first] == pytest.approx([s.pv for s in second], abs=1e-3)


@on_vcan
def test_a_plant_with_its_own_clock_is_listened_to(start: Start, url: str) -> None:
    start_loop(start, url, speed="100")
    loop = BusLoop(url, CONTROLLER, PLANT)
    result = run(tiny_plan(), loop, limits=LIMITS)
    loop.close()
    assert result.ended is None
    assert result.restored is not None
    assert as_configured(result.restored)


def test_gains_are_accepted_and_stay(loop: BusLoop) -> None:
    state = loop.accept(TRIED, GAINS)
    assert (state.gains, state.on_trial) == (TRIED, False)
    run(wait(20), loop, limits=LIMITS)
    assert loop.read().gains == TRIED


TRIAL = """
import sys
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, SetGains, SetMode, SetSetpoint
loop = BusLoop(sys.argv[1], 0x20, 0x10)
loop.begin()
commands = (SetGains(Gains(80.0, 6.0)), SetSetpoint(50.5), SetMode(Mode.MANUAL))
for count in range(10**9):
    sample = loop.step(commands if count == 0 else ())
    if count == 50:
        print("in trial", sample.mode, sample.sp, flush=True)
"""


@on_vcan
@pytest.mark.parametrize(
    ("speed", "end"), [("max", signal.SIGKILL), ("max", signal.SIGSTOP), ("1", signal.SIGKILL)], ids=str
)
def test_a_tuner_that_dies_or_hangs_loses_the_loop(start: Start, url: str, speed: str, end: signal.Signals) -> None:
    start_loop(start, url, speed)
    observer = BusLoop(url, CONTROLLER, PLANT)
    tuner = subprocess.Popen([sys.executable, "-c", TRIAL, url], stdout=subprocess.PIPE, text=True)
    with tuner:
        assert tuner.stdout is not None
        assert tuner.stdout.readline() == "in trial 1 50.5\n"
        try:
            assert observer.read().on_trial
        except BaseException:
            tuner.kill()  # else it is waited for without end
            raise
        tuner.send_signal(end)
        give_up = time.monotonic() + 4.0
        while not as_configured(observer.read()) and time.monotonic() < give_up:
            time.sleep(0.05)
        tuner.kill()
    assert as_configured(observer.read()), observer.read()
    result = run(wait(20), observer, limits=LIMITS)
    assert result.ended is None, "the next job runs"
    observer.close()


def until_ended(loop: BusLoop, break_it: Callable[[], object], limit_s: float) -> tuple[Reason, LoopState]:
    state = loop.begin()
    for _ in range(20):
        loop.step(())
    break_it()
    since = time.monotonic()
    with pytest.raises(Ended) as caught:
        while time.monotonic() < since + 10:
            loop.step(())
    assert time.monotonic() - since < limit_s
    assert isinstance(caught.value, Failed)
    return caught.value.reason, state


@on_vcan
@pytest.mark.parametrize("who", ["controller", "plant"])
def test_a_node_that_is_gone_is_noticed(loop: BusLoop, devices: dict[str, subprocess.Popen[str]], who: str) -> None:
    reason, state = until_ended(loop, devices[who].kill, limit_s=3.0)
    assert reason is Reason.NODE_LOST
    if who == "controller":
        with pytest.raises(Failed) as caught:
            loop.restore(state)
        assert caught.value.reason is Reason.RESTORE_UNCONFIRMED
    else:
        assert as_configured(loop.restore(state).state)


@on_vcan
def test_a_bus_that_goes_down_is_noticed_and_the_loop_restored_when_it_is_back(loop: BusLoop) -> None:
    def link(state: str) -> None:
        subprocess.run(["ip", "link", "set", "vcan0", state], check=True)

    try:
        reason, state = until_ended(loop, lambda: link("down"), limit_s=3.0)
        assert reason is Reason.BUS_LOST
    finally:
        link("up")
    assert as_configured(loop.restore(state).state)


@on_vcan
def test_a_hand_on_the_set_point_shows_in_the_samples(loop: BusLoop, url: str) -> None:
    bus = open_bus(url)

    def plan() -> Plan[None]:
        yield from wait(20)
        bus.send(channel_ids(1).command, COMMAND_FRAME.pack(50.125))
        yield from wait(500)

    result = run(plan(), loop, limits=LIMITS)
    bus.close()
    assert result.ended is not None
    assert result.ended.reason is Reason.SETPOINT_CHANGED
    assert loop.read().sp == 50.125, "another's hand has the last word"


@on_vcan
@pytest.mark.parametrize(("controller", "plant"), [(PLANT, None), (CONTROLLER, CONTROLLER)])
def test_a_device_of_another_kind_is_refused(devices: object, url: str, controller: int, plant: int | None) -> None:
    loop = BusLoop(url, controller, plant)
    with pytest.raises(Refused) as caught:
        loop.begin()
    assert caught.value.reason is Reason.DEVICE_MISMATCH
    loop.close()


@on_vcan
def test_a_bus_or_node_that_is_not_there(url: str) -> None:
    for where, reason in (("socketcan:nothing0", Reason.BUS_LOST), (url, Reason.NODE_LOST)):
        loop = BusLoop(where, CONTROLLER, PLANT)
        with pytest.raises(Failed) as caught:
            loop.begin()
        assert caught.value.reason is reason
        loop.close()


@on_vcan
def test_what_the_controller_refuses_is_said(loop: BusLoop) -> None:
    state = loop.begin()
    commands: Sequence[SetOutput] = (SetOutput(150.0),)
    with pytest.raises(Refused, match="above the limit") as caught:
        loop.step(commands)
    assert caught.value.reason is Reason.BAD_INPUT
    assert as_configured(loop.restore(state).state)
