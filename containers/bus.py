"""The bus container: vcan0 in the network namespace that the others join, or the loopback hub where there is no vcan.

It also forwards connections from outside to the service, which listens on the loopback address of this namespace: only
the port that docker-compose.yml publishes is reachable.
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from loopwright.containers import keeper
from loopwright.containers.vcan import NoVcan, make
from loopwright.protocol.hub import Hub

INTERFACE = "vcan0"
DOOR, SERVICE = 8081, 8080
_CHUNK = 65536


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m loopwright.containers.bus", description="The bus of docker-compose.yml."
    )
    parser.add_argument("--kind", choices=("auto", "vcan", "hub"), default="auto", help="auto: vcan if it is available")
    try:
        with _bus(parser.parse_args(argv).kind) as url:
            asyncio.run(_keep(url))
    except (NoVcan, OSError) as error:
        print(f"bus: {error}", file=sys.stderr)
        return 1
    return 0


@contextmanager
def _bus(kind: str) -> Iterator[str]:
    """Yields the address of the bus, which exists until the context ends."""
    if kind != "hub":
        try:
            make(INTERFACE)
            yield f"socketcan:{INTERFACE}"
            return
        except NoVcan as error:
            if kind == "vcan":
                raise
            print(f"bus: {error}; the loopback hub is used instead", flush=True)
    hub = Hub()
    serving = threading.Thread(target=hub.serve)
    serving.start()
    try:
        yield hub.url
    finally:
        hub.stop()
        serving.join()


async def _keep(url: str) -> None:
    """Holds the bus until SIGTERM or SIGINT."""
    end = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, end.set)

    async def tell(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(f"{url}\n".encode("ascii"))
        with suppress(ConnectionError):
            await reader.read()
        writer.close()

    host, port = keeper.ADDRESS
    # The servers are not closed: closing waits for the connections, and these last as long as this process.
    _servers = await asyncio.start_server(tell, host, port), await asyncio.start_server(_forward, "0.0.0.0", DOOR)
    print(f"ready {url}", flush=True)
    await end.wait()


async def _forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Forwards one connection from outside to the service and back."""
    try:
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", SERVICE)
    except OSError:  # the service is starting
        writer.close()
        return
    await asyncio.gather(copy(reader, inner_writer), copy(inner_reader, writer))


async def copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    """Ends the other side when one side ends: an event stream that a browser closes must not stay open inside."""
    try:
        with suppress(OSError):  # a caller that vanishes ends as a time-out, or as a host that is not reached
            while data := await source.read(_CHUNK):
                target.write(data)
                await target.drain()
    finally:
        target.close()


if __name__ == "__main__":
    sys.exit(main())
