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
from contextlib import suppress

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
        node = _node(options.argument or "") if options.what == "node" else None
        if options.what == "service":
            answers(options.argument or SERVICE)
        else:
            url, connection = keeper.join(0.0)
            with connection:
                if node is not None:
                    hear(url, _HEARTBEAT + node)
    except (OSError, keeper.NoBus) as error:
        print(f"{options.what}: {error}")
        return 1
    except ValueError as error:
        parser.error(f"{options.what}: {error}")
    return 0


def _node(text: str) -> int:
    """Returns a node-ID. Raises ValueError."""
    with suppress(ValueError):
        if 1 <= (node := int(text, 0)) <= 127:
            return node
    raise ValueError(f"{text!r} is no node-ID: give one of 1 to 127, or as 0x20")


def answers(url: str) -> None:
    """Raises OSError when the service does not answer, or reports that it is not well, and ValueError for a URL that
    is none."""
    import http.client  # the three take half of the time of the other checks
    import urllib.error
    import urllib.request

    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        opener.open(f"{url}/healthz", timeout=_WAIT_S).close()
    except urllib.error.HTTPError as error:
        if error.code != 404:
            raise
        opener.open(f"{url}/loops", timeout=_WAIT_S).close()
    except http.client.InvalidURL as error:
        raise ValueError(str(error)) from error
    except http.client.HTTPException as error:
        raise ConnectionError(f"{url} answers, and not as a service does: {error!r}") from error


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
                part = hub.recv(65536)
            except TimeoutError:
                return False
            if not part:
                raise ConnectionError(f"the hub at {address} has ended")
            received += part
            if wanted in received.lower():
                return True
            received = received[-len(wanted) :]
    return False


if __name__ == "__main__":
    sys.exit(main())
