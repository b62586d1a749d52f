"""Health checks of docker-compose.yml: exit status 0, or 1 with a message. They are cheap enough to run often.

python -m loopwright.containers.health bus             the bus exists
python -m loopwright.containers.health node 0x20       a heartbeat of this node within 2 s
python -m loopwright.containers.health service [URL]   the service answers
"""

from __future__ import annotations

import argparse
import socket
import struct
import sys
import time
from collections.abc import Sequence

from loopwright.containers import keeper

SERVICE = "http://127.0.0.1:8080"
_HEARTBEAT = 0x700
_WAIT_S = 2.0


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m loopwright.containers.health", description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("bus", "node", "service"))
    parser.add_argument("argument", nargs="?", help="node: its number; service: where it is")
    options = parser.parse_args(argv)
    try:
        if options.what == "service":
            answers(options.argument or SERVICE)
        else:
            url, connection = keeper.join(0.0)
            with connection:
                if options.what == "node":
                    hear(url, _HEARTBEAT + int(options.argument, 0))
    except (OSError, keeper.NoBus) as error:
        print(f"{options.what}: {error}")
        return 1
    return 0


def answers(url: str) -> None:
    """Raises OSError when the service does not answer, or reports that it is not well."""
    import urllib.error  # takes half of the time of the other checks
    import urllib.request

    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        opener.open(f"{url}/healthz", timeout=_WAIT_S).close()
    except urllib.error.HTTPError as error:
        if error.code != 404:
            raise
        opener.open(f"{url}/loops", timeout=_WAIT_S).close()


def hear(bus: str, can_id: int) -> None:
    """Waits for one frame with this identifier. Raises OSError when none came in time."""
    kind, _, address = bus.partition(":")
    heard = _on_socketcan(address, can_id) if kind == "socketcan" else _on_hub(address, can_id)
    if not heard:
        raise TimeoutError(f"no frame {can_id:#x} on {bus} within {_WAIT_S:g} s")


def _on_socketcan(interface: str, can_id: int) -> bool:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
        can.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", can_id, socket.CAN_SFF_MASK))
        can.bind((interface,))
        can.settimeout(_WAIT_S)
        try:
            return bool(can.recv(16))
        except TimeoutError:
            return False


def _on_hub(address: str, can_id: int) -> bool:
    """Waits for the frame in the raw mode of socketcand, see protocol/hub.py."""
    host, _, port = address.rpartition(":")
    wanted = f"< frame {can_id:03x} ".encode()
    with socket.create_connection((host, int(port)), timeout=_WAIT_S) as hub:
        for words in (b"", b"< open vcan0 >", b"< rawmode >"):
            hub.sendall(words)
            hub.recv(64)
        give_up = time.monotonic() + _WAIT_S
        received = b""
        while (left := give_up - time.monotonic()) > 0:
            hub.settimeout(left)
            try:
                received += hub.recv(65536)
            except TimeoutError:
                return False
            if wanted in received.lower():
                return True
            received = received[-len(wanted) :]
    return False


if __name__ == "__main__":
    sys.exit(main())
