"""The demo's loop: its jobs, its plant's pace, and the controller's own word."""

import json
import subprocess
from typing import Any

from compose_test.shell import Wrong, in_uml, output, until
from compose_test.stack import ask, container

TAG = "TIC-101"
# The controller's own word, over the bus: not the service's, which is being killed.
_LOOK = """
import json, sys, time
from loopwright.containers import keeper
from loopwright.service.loops.bus_loop import BusLoop
url, _ = keeper.join(5.0)
loop = BusLoop(url, 0x20, 0x10)
print("looking", flush=True)
for _ in range(400):
    state = loop.read()
    home = [state.mode.name, state.on_trial, state.sp, state.gains.Kp] == ["AUTOMATIC", False, 50.0, 80.0]
    print(json.dumps([time.time(), home, str(state)]), flush=True)
    time.sleep(0.02)
"""
_PACE = """
import sys
from loopwright.containers import keeper
from loopwright.protocol.tuner import Tuner
url, _ = keeper.join(5.0)
Tuner(url, 0x20, 0x10).write("plant_pace", float(sys.argv[1]))
"""
FULL_SPEED = 0.0
SLOW = 0.2
"""A relay stage of a minute: looking at it from user-mode Linux takes some time to begin."""


def pace(factor: float) -> None:
    """The plant's, times real time."""
    output("docker", "exec", container("controller"), "python", "-c", _PACE, str(factor))


def at_rest_soon() -> None:
    """The loop swings for 20 s of plant time with its gains; as fast as the machine can do beside other work."""
    pace(5.0 if in_uml() else FULL_SPEED)


def in_mid_stage() -> str:
    """A job in its relay stage, the plant slow enough for that to last; its URL."""
    pace(SLOW)
    url = str(ask(f"/loops/{TAG}/retune", {"by": "compose-test"})["url"])

    def there() -> bool:
        job = ask(url)
        if job["state"] not in ("queued", "running"):
            raise Wrong(f"the job ended before its relay stage: {job['reason']}: {job['detail']}")
        return job["stage"] == "relay" and ask(f"/loops/{TAG}")["live"]["mode"] == "experiment"

    until("the relay stage", there, 120.0)
    return url


def ended(url: str, port: str = "LOOPWRIGHT_PORT") -> Any:
    def over() -> Any:
        job = ask(url, port=port)
        return job if job["state"] not in ("queued", "running") else None

    return until("the end of the job", over, 300.0)


def in_automatic() -> Any:
    live = ask(f"/loops/{TAG}")["live"]
    return live if live["mode"] == "automatic" and not live["on_trial"] else None


class Look:
    """Reads the controller back over the bus, every 20 ms or so."""

    def __init__(self) -> None:
        command = ["docker", "exec", container("controller"), "python", "-c", _LOOK]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self._line()

    def now(self) -> tuple[float, bool, str]:
        """When, whether the loop is as its operator left it, and how it is."""
        at, home, state = json.loads(self._line())
        return at, home, state

    def _line(self) -> str:
        assert self._process.stdout is not None
        if line := self._process.stdout.readline():
            return line
        raise Wrong("the controller did not go back, or cannot be read")

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
