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
from contextlib import suppress
from pathlib import Path
from types import FrameType

from loopwright.containers import keeper

BUS_GONE = 75
"""Exit status when the bus has ended: "try again" (EX_TEMPFAIL)."""
NO_COMMAND = 127
"""Exit status when the command cannot be started, as of a shell."""
_JOIN_S = 20.0
_STOP_S = 9.0
"""Time that the command has to restore its loops, s, before the engine's 10 s are over."""
_BUS_RESTARTS_S = 3.0
"""Time for which the bus must have restarted before the engine restarts this container, s: the engine does not try
twice."""
_ENDINGS = (signal.SIGTERM, signal.SIGINT)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m loopwright.containers.member", description=__doc__.split("\n")[0])
    parser.add_argument("--need", metavar="VARIABLE", help="environment variable without which nothing is started")
    parser.add_argument(
        "--set", action="append", default=[], type=_setting, metavar="NAME=VALUE", help="fills in {NAME} too"
    )
    parser.add_argument(
        "--write", nargs=2, type=Path, metavar=("TEMPLATE", "FILE"), help="file to write, with all names filled in"
    )
    parser.add_argument("command", nargs="+")
    options = parser.parse_args(argv)
    if options.need and not os.environ.get(options.need):
        print(f"member: {options.need} is not set; .env.example says what it has to be", file=sys.stderr)
        return 1
    for number in _ENDINGS:  # what runs as the first process of its container ignores a signal that it does not handle
        signal.signal(number, _end)
    try:
        url, connection = keeper.join(_JOIN_S)
        known = dict(options.set) | {"bus": url}
        if options.write:
            template, target = options.write
            target.write_text(_filled(template.read_text(encoding="utf-8"), known), encoding="utf-8")
    except UnicodeDecodeError as error:
        print(f"member: {options.write[0]} is no text in UTF-8: {error}", file=sys.stderr)
        return 2
    except (keeper.NoBus, OSError) as error:
        print(f"member: {error}", file=sys.stderr)
        return 1
    with connection:
        return _run([_filled(word, known) for word in options.command], connection)


def _setting(text: str) -> tuple[str, str]:
    name, separator, value = text.partition("=")
    if not (name and separator):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, value


def _end(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)


def _filled(text: str, known: dict[str, str]) -> str:
    for name, value in known.items():
        text = text.replace(f"{{{name}}}", value)
    return text


def _run(command: list[str], connection: socket.socket) -> int:
    process: subprocess.Popen[bytes] | None = None
    asked, gone = threading.Event(), threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        asked.set()
        if process is not None:
            process.terminate()

    for number in _ENDINGS:
        signal.signal(number, stop)
    try:
        process = subprocess.Popen(command)
    except OSError as error:
        print(f"member: {command[0]!r} cannot be started: {error.strerror}", file=sys.stderr)
        return NO_COMMAND
    if asked.is_set():  # while it was being started
        process.terminate()
    threading.Thread(target=_watch, args=(connection, process, gone), daemon=True).start()
    status = process.wait()
    if gone.is_set():
        print("member: the bus has ended; this container ends too, to join the next bus", file=sys.stderr, flush=True)
        time.sleep(_BUS_RESTARTS_S)
        return BUS_GONE
    return status if status >= 0 else 128 - status


def _watch(connection: socket.socket, process: subprocess.Popen[bytes], gone: threading.Event) -> None:
    """Ends the process when the connection ends, however it does."""
    with suppress(OSError):
        connection.recv(1)
    gone.set()
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()


if __name__ == "__main__":
    sys.exit(main())
