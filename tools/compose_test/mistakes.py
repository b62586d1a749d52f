"""What users do wrong: each gets a line that says so."""

import os
import socket
import subprocess

from compose_test.scenario import stack
from compose_test.shell import check, expect, output, read_all, tell, until, works
from compose_test.stack import IMAGE, compose, wait_healthy

_ROOT = ("--user", "0:0")
_RIGHT = (*_ROOT, "--cap-add", "NET_ADMIN")
_NO_RIGHT = (*_ROOT, "--cap-drop", "ALL")


def mistakes() -> None:
    tell("\n== mistakes")
    with stack(LOOPWRIGHT_BUS="hub"):
        _port_taken()
    vcan = has_vcan()
    for kind in ("auto", "vcan"):
        ready = {"auto": True, "vcan": False}[kind]
        expect(f"no NET_ADMIN, {kind}", bus_says(kind, ready, *_NO_RIGHT), "NET_ADMIN")
        if not vcan:
            expect(f"no vcan module, {kind}", bus_says(kind, ready, *_RIGHT), "modprobe vcan")
    _wrong_base()
    _no_database()


def has_vcan() -> bool:
    return "ready socketcan:" in bus_says("auto", True, *_RIGHT)


def _port_taken() -> None:
    with socket.create_server(("127.0.0.1", int(os.environ["LOOPWRIGHT_PORT"]))):
        told = compose("up", "--detach", "bus", check=False)
        expect("port taken", told, os.environ["LOOPWRIGHT_PORT"])
    compose("up", "--detach", "bus")
    wait_healthy(("bus",))


def _wrong_base() -> None:
    name = f"{IMAGE}:no-python"
    made = subprocess.run(
        ["docker", "build", "--quiet", "--tag", name, "-"], capture_output=True, text=True, check=False,
        input=f"FROM {os.environ['BASE_IMAGE']}\nRUN rm -f /usr/bin/python* /usr/local/bin/python*\n",
    )  # fmt: skip
    check("a base image without Python can be made", made.returncode == 0, made.stderr)
    told = read_all("docker", "build", "--force-rm", "--build-arg", f"BASE_IMAGE={name}", ".", timeout=120.0)
    works("docker", "image", "rm", "--force", name)
    expect("wrong base image", told, "BASE_IMAGE needs")


def _no_database() -> None:
    """The profile alone, without the other half of it."""
    command = ("python", "-m", "loopwright.containers.member", "--need=LOOPWRIGHT_DATABASE", "--", "true")
    expect("two gateways, no database named", read_all("docker", "run", "--rm", "--network", "none", IMAGE, *command),
           "LOOPWRIGHT_DATABASE is not set")  # fmt: skip


def bus_says(kind: str, ready: bool, *options: str) -> str:
    """The first words of a bus container with these options, or its last if it is not to be ready."""
    name = f"{IMAGE}-bus"
    command = ("python", "-m", "loopwright.containers.bus", "--kind", kind)
    output("docker", "run", "--detach", "--network", "none", "--name", name, *options, IMAGE, *command)

    def enough() -> bool:
        state = output("docker", "inspect", "--format", "{{.State.Running}} {{.State.ExitCode}}", name).split()
        if state[0] == "false" and (ready or state[1] != "1"):
            check(f"a bus, kind {kind}", False, f"exit status {state[1]}: {read_all('docker', 'logs', name)}")
        return state[0] == "false" or (ready and "ready" in read_all("docker", "logs", name))

    try:
        until("a bus" if ready else "the end of a bus", enough, 30.0)
        return read_all("docker", "logs", name)
    finally:
        works("docker", "rm", "--force", name)
