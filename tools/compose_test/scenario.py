"""What is gone through on either bus: up, the demo, kill, stop, restart, and in between what a test is given to do."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from functools import partial

from compose_test.loop import FULL_SPEED, TAG, Look, at_rest_soon, ended, in_automatic, in_mid_stage, pace
from compose_test.shell import check, read_all, tell, until
from compose_test.stack import (
    DEVICES,
    UP_S,
    compose,
    container,
    free_port,
    healthy,
    inspect,
    logs,
    memory,
    nothing_left,
    signalled,
    started_at,
    wait_for,
    wait_healthy,
)

# All processes of the container but its first and itself; says when. The first ends with what it started.
_KILL = "import os, time; print(time.time(), flush=True); os.kill(-1, 9)"
BACK_WITHIN_S = 2.5
"""1.5 s of heartbeat time; the device's tick, and reading it all back by SDO on a slow machine."""
STOPPED_WITHIN_S = 10.0


@contextlib.contextmanager
def stack(**settings: str) -> Iterator[None]:
    """Everything that is brought up in here is taken down, and nothing of it may be left."""
    before = {name: os.environ.get(name) for name in settings}
    os.environ |= settings | {"LOOPWRIGHT_PORT": str(free_port())}
    try:
        yield
    except BaseException:
        print(compose("logs", "--no-color", "--tail=40", check=False), file=sys.stderr)
        raise
    finally:
        compose("down", "--volumes", "--timeout=10", check=False)
        left = nothing_left()
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value
    check("down leaves no container, volume or network", not left, left)


def scenario(kind: str, *more: Callable[[], None], briefly: bool = False) -> None:
    """briefly: without the stop and without restarts of what is not the bus itself: they are the same on each bus."""
    tell(f"\n== {kind}")
    with stack(LOOPWRIGHT_BUS=kind):
        started = time.monotonic()
        compose("up", "--detach", *DEVICES)
        wait_healthy()
        seconds = time.monotonic() - started
        tell(f"up          healthy after {seconds:.1f} s")
        tell("bus         " + logs("bus").strip().splitlines()[-1].strip())
        _demonstrate(seconds)
        tell("memory      " + memory(DEVICES))
        _killed_in_mid_stage()
        if not briefly:
            _stopped_in_mid_stage()
        _restart_each(("bus",) if briefly else DEVICES)
        for one in more:
            one()


def _demonstrate(up_s: float) -> None:
    pace(FULL_SPEED)
    started = time.monotonic()
    compose("up", "--detach", "demo")
    status = wait_for("demo", 300.0)
    seconds = time.monotonic() - started
    tell(logs("demo").rstrip())
    check(f"demo proposed, {up_s + seconds:.0f} s from up to its proof", status == 0, f"exit status {status}")
    page = f"http://127.0.0.1:{os.environ['LOOPWRIGHT_PORT']}/ui/loops/{TAG}"
    check("the demo names the page", page in logs("demo"), logs("demo"))
    pace(FULL_SPEED)  # the demo has left it in real time, and the loop still swings


def _killed_in_mid_stage() -> None:
    job = in_mid_stage()
    look = Look()
    try:
        _, home, state = look.now()
        check("the loop is away from its set-up in mid-stage", not home, state)
        before = started_at()["service"]
        killed = float(read_all("docker", "exec", container("service"), "python", "-c", _KILL))
        while not home:
            at, home, state = look.now()
    finally:
        look.close()
    tell(f"kill -9     service in the relay stage: controller back on its accepted gains {at - killed:.2f} s later")
    check(f"back within {BACK_WITHIN_S:g} s", at - killed < BACK_WITHIN_S)
    at_rest_soon()
    until("the service anew", lambda: healthy({"service": before}), UP_S)
    found = ended(job)
    why = f", {found['reason']}: {found['detail']}" if found["reason"] else ""
    tell(f"            job {found['state']} in attempt {found['attempts']}{why}")
    resumed = found["state"] == "proposed" and found["attempts"] > 1
    check("the job went on to its end, or says why not", resumed or found["state"] == "interrupted", str(found))


def _stopped_in_mid_stage() -> None:
    job = in_mid_stage()
    before = time.time()
    compose("stop")
    # From SIGTERM on: compose itself takes seconds to begin in user-mode Linux.
    signal_at = signalled("service", before)
    gone, status = inspect("service", "{{.State.FinishedAt}} {{.State.ExitCode}}").split()
    seconds = datetime.fromisoformat(gone[:26].rstrip("Z") + "+00:00").timestamp() - signal_at
    tell(f"stop        service in the relay stage: gone after {seconds:.1f} s with status {status}")
    # 143: ended by SIGTERM when everything was done, as the web server does it; 137: the engine lost its patience.
    check(f"graceful within {STOPPED_WITHIN_S:g} s", seconds < STOPPED_WITHIN_S and status in ("0", "143"), status)
    compose("up", "--detach")
    wait_healthy()
    found = ended(job)
    tell(f"up again    job {found['state']}, reason {found['reason']}: {found['detail']}")
    safe = found["restored"] or {}
    check("its loop was made safe", (safe.get("mode"), safe.get("on_trial")) == ("automatic", False), str(safe))
    check("the next demo goes on from there", wait_for("demo", 300.0) == 0, logs("demo"))


def _restart_each(names: Sequence[str]) -> None:
    for name in names:
        started = time.monotonic()
        before = started_at()
        compose("restart", name)
        # A bus that starts anew takes the others with it: they have to join its network namespace.
        expected = DEVICES if name == "bus" else (name,)
        until(f"{name} anew", partial(healthy, {one: before[one] for one in expected}), UP_S)
        live = until("the loop in automatic", in_automatic, 60.0)
        seconds = time.monotonic() - started
        tell(f"restart     {name}: healthy after {seconds:.1f} s, Kp {live['gains']['Kp']:g}, SP {live['sp']:g}")
