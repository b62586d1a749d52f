"""Runs a command on the bus of this network namespace, for as long as there is that bus.

    python -m loopwright.containers.member [--set NAME=VALUE] [--write TEMPLATE FILE] -- COMMAND...

{bus} in an argument, and in TEMPLATE, which is written to FILE, stands for the address of the bus, {NAME} for VALUE.
When the bus ends, the command is ended as by `docker stop`, and this container with it; restarted, it joins the new
bus.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from loopwright.containers import keeper

BUS_GONE = 75
"""Exit status when the bus has ended: "try again" (EX_TEMPFAIL)."""
_JOIN_S = 20.0
_STOP_S = 9.0
"""Time that the command has to restore its loops, s, before the engine's 10 s are over."""
_BUS_RESTARTS_S = 3.0
"""Time for which the bus must have restarted before the engine restarts this container, s: the engine does not try
twice."""


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m loopwright.containers.member", description=__doc__.split("\n")[0])
    parser.add_argument("--need", metavar="VARIABLE", help="environment variable without which nothing is started")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="fills in {NAME} too")
    parser.add_argument(
        "--write", nargs=2, type=Path, metavar=("TEMPLATE", "FILE"), help="file to write, with all names filled in"
    )
    parser.add_argument("command", nargs="+")
    options = parser.parse_args(argv)
    if options.need and not os.environ.get(options.need):
        print(f"member: {options.need} is not set; .env.example says what it has to be", file=sys.stderr)
        return 1
    try:
        url, connection = keeper.join(_JOIN_S)
        known = dict(word.split("=", 1) for word in options.set) | {"bus": url}
        if options.write:
            template, target = options.write
            target.write_text(_filled(template.read_text(encoding="utf-8"), known), encoding="utf-8")
    except (keeper.NoBus, OSError) as error:
        print(f"member: {error}", file=sys.stderr)
        return 1
    with connection:
        return _run([_filled(word, known) for word in options.command], connection)


def _filled(text: str, known: dict[str, str]) -> str:
    for name, value in known.items():
        text = text.replace(f"{{{name}}}", value)
    return text


def _run(command: list[str], connection: socket.socket) -> int:
    process = subprocess.Popen(command)
    gone = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        process.terminate()

    def watch() -> None:
        connection.recv(1)
        gone.set()
        process.terminate()
        try:
            process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    threading.Thread(target=watch, daemon=True).start()
    status = process.wait()
    if gone.is_set():
        print("member: the bus has ended; this container ends too, to join the next bus", file=sys.stderr, flush=True)
        time.sleep(_BUS_RESTARTS_S)
        return BUS_GONE
    return status if status >= 0 else 128 - status


if __name__ == "__main__":
    sys.exit(main())
