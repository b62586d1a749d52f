"""The profile `postgres`: two gateways, each with its own bus and loop, on one database."""

import time

from compose_test.loop import TAG, ended, in_mid_stage
from compose_test.scenario import stack
from compose_test.shell import check, expect, tell
from compose_test.stack import ask, compose, free_port, logs, memory, wait_healthy

_B = tuple(f"{name}-b" for name in ("bus", "plant", "controller", "service"))
_ALL = ("bus", "plant", "controller", "service", *_B, "database")
_URL = "postgresql://loopwright@/loopwright?host=/run/postgresql"
_DOOR_B = "LOOPWRIGHT_PORT_B"


def fleet(kind: str) -> None:
    tell(f"\n== two gateways on PostgreSQL, {kind}")
    with stack(
        LOOPWRIGHT_BUS=kind, COMPOSE_PROFILES="postgres", LOOPWRIGHT_DATABASE=_URL, LOOPWRIGHT_SPEED="20",
        LOOPWRIGHT_PORT_B=str(free_port()),
    ):  # fmt: skip
        started = time.monotonic()
        compose("up", "--detach", *_ALL)
        wait_healthy(_ALL)
        tell(f"up          all nine healthy after {time.monotonic() - started:.1f} s")
        for door in ("LOOPWRIGHT_PORT", _DOOR_B):
            found = {loop["tag"]: loop["gateway"] for loop in ask("/loops", port=door)}
            check(f"both loops are shown at {door}", found == {TAG: "gateway-a", "TIC-201": "gateway-b"}, str(found))
        job = ask(f"/loops/{TAG}/retune", {"by": "gateway b"}, port=_DOOR_B)
        told = ended(job["url"], port=_DOOR_B)
        tell(f"posted at B job on {TAG}, run by {told['gateway']}: {told['state']}")
        check("run by the gateway that has the bus", (told["gateway"], told["state"]) == ("gateway-a", "proposed"))
        expect("A's own log says so", logs("service"), f"job started, attempt 1 job={job['id']}")
        check("B's does not", f"job started, attempt 1 job={job['id']}" not in logs("service-b"), logs("service-b"))
        tell("memory      " + memory(_ALL))
        url = in_mid_stage()
        compose("stop")
        compose("up", "--detach", *_ALL)
        wait_healthy(_ALL)
        told = ended(url, port=_DOOR_B)
        tell(f"up again    job of A, as B tells it: {told['state']}, reason {told['reason']}: {told['detail']}")
        check(
            "the database outlived the gateways' stop",
            (told["state"], told["reason"]) == ("aborted", "service_stopped"),
        )
