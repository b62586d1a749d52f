"""Clients that mean harm, or are broken so that it looks the same: each function is one of them, for ever.

    python -m tests.hostile.attackers URL NAME[=NUMBER] ... [--key KEY] [--silent TAG] [--loop TAG]

A process of its own, so that what it costs to attack is not counted as the service's, and of the lowest priority: real
attackers have a machine of their own, and where they share the service's, what is measured is to be the service and not
the processor time that they take from it. For the same reason who is refused pauses. On SIGTERM it
prints what it was answered, by attacker and status, and ends.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import resource
import secrets
import signal
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from urllib.parse import urlsplit

PAUSE_S = 1.0
"""After an answer that refuses: an attacker that never pauses measures its own event loop."""
BACK_S = 5.0
"""After it was thrown out."""
NICENESS = 19


@dataclass
class Target:
    """Where the service is, and what an attacker knows of it. answers: by attacker and status; "closed": none."""

    host: str
    port: int
    key: str = ""
    silent: str = "SILENT"
    loop: str = "TIC-101"
    answers: Counter[str] = field(default_factory=Counter)

    async def open(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection(self.host, self.port)

    def head(self, method: str, path: str, *more: str, key: str = "") -> bytes:
        key = key or self.key
        lines = [f"{method} {path} HTTP/1.1", f"Host: {self.host}:{self.port}", *more]
        lines += [f"Authorization: Bearer {key}"] if key else []
        return ("\r\n".join(lines) + "\r\n\r\n").encode()

    async def answered(self, who: str, reader: asyncio.StreamReader) -> str:
        """The status of the next answer, and the answer taken whole."""
        line = await reader.readline()
        status = line.split()[1].decode() if line else "closed"
        self.answers[f"{who} {status}"] += 1
        length = 0
        while (name := await reader.readline()) not in (b"\r\n", b""):
            if name.lower().startswith(b"content-length:"):
                length = int(name.split(b":")[1])
        await reader.readexactly(length)
        return status


async def reads_of_a_silent_node(target: Target) -> None:
    """Asks for the live state of a loop whose node does not answer, again and again."""
    reader, writer = await target.open()
    while True:
        writer.write(target.head("GET", f"/loops/{target.silent}"))
        if await target.answered("silent", reader) in ("429", "closed"):
            await asyncio.sleep(PAUSE_S)


async def unfinished_bodies(target: Target) -> None:
    """Begins a body and sends a byte of it a second."""
    reader, writer = await target.open()
    writer.write(target.head("POST", f"/loops/{target.loop}/retune", "Content-Length: 900", "Content-Type: text/json"))
    answer = asyncio.ensure_future(target.answered("body", reader))
    while not answer.done():
        writer.write(b" ")
        await asyncio.wait({answer}, timeout=1.0)
    writer.close()
    answer.result()


async def guesses_at_a_key(target: Target) -> None:
    """Wrong secrets with the id of a key that is valid."""
    reader, writer = await target.open()
    while True:
        wrong = f"{target.key.rpartition('_')[0][:15]}_{secrets.token_urlsafe(32)}"
        writer.write(target.head("GET", "/loops", key=wrong))
        if await target.answered("guess", reader) in ("429", "closed"):
            await asyncio.sleep(PAUSE_S)


async def idle_connections(target: Target) -> None:
    """Opens a connection and says nothing."""
    reader, writer = await target.open()
    await target.answered("idle", reader)
    writer.close()


async def slow_heads(target: Target) -> None:
    """Sends a head, a byte a second (slowloris)."""
    reader, writer = await target.open()
    answer = asyncio.ensure_future(target.answered("head", reader))
    for byte in target.head("GET", "/loops"):
        writer.write(bytes((byte,)))
        if (await asyncio.wait({answer}, timeout=1.0))[0]:
            break
    writer.close()
    await answer


async def reads_of_the_database(target: Target) -> None:
    """Asks for lists as fast as they come."""
    reader, writer = await target.open()
    while True:
        writer.write(target.head("GET", "/jobs?limit=200"))
        if await target.answered("reads", reader) in ("429", "closed"):
            await asyncio.sleep(PAUSE_S)


async def answers_not_taken(target: Target) -> None:
    """Asks for long answers and takes none."""
    _, writer = await target.open()
    for _ in range(200):
        writer.write(target.head("GET", "/openapi.json"))
    await asyncio.sleep(60.0)
    writer.close()


async def posts_again(target: Target, who: str, path: str, bodies: Sequence[dict[str, object]]) -> None:
    reader, writer = await target.open()
    for body in itertools.cycle(bodies):
        data = json.dumps(body).encode()
        more = (f"Content-Length: {len(data)}", "Content-Type: application/json")
        writer.write(target.head("POST", path, *more) + data)
        if await target.answered(who, reader) in ("409", "422", "429", "503", "closed"):
            await asyncio.sleep(PAUSE_S)


async def costly_tunings(target: Target) -> None:
    """Models far outside any plant."""
    models: list[dict[str, object]] = [
        {"model": {"K": 1e-308, "T": 1.0, "L": 1.0}},
        {"model": {"K": 1.0, "T": 1.0, "L": 1e-9}, "method": "me-pso"},
        {"model": {"num": [1.0], "den": [1e-12, 1e12, 1.0, 1e-9], "dead_time_s": 1.0}, "method": "all"},
    ]
    await posts_again(target, "tunings", "/tunings", models)


async def costly_rehearsals(target: Target) -> None:
    """A dry run of a plant with a dead time of weeks."""
    model = {"K": 1.0, "T_s": 1e6, "L_s": 4e6}
    await posts_again(target, "rehearsal", f"/loops/{target.loop}/retune", [{"dry_run": True, "model": model}])


ATTACKERS: dict[str, Callable[[Target], Awaitable[None]]] = {
    each.__name__: each
    for each in (
        reads_of_a_silent_node, unfinished_bodies, guesses_at_a_key, idle_connections, slow_heads,
        reads_of_the_database, answers_not_taken, costly_tunings, costly_rehearsals,
    )
}  # fmt: skip


async def again_and_again(attack: Callable[[Target], Awaitable[None]], target: Target) -> None:
    """An attacker that is thrown out comes back."""
    while True:
        try:
            await attack(target)
        except (OSError, asyncio.IncompleteReadError, IndexError):
            target.answers[f"{attack.__name__} thrown out"] += 1
        await asyncio.sleep(BACK_S)


async def attack(target: Target, numbers: dict[str, int]) -> None:
    over = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, over.set)
    tasks = [
        asyncio.ensure_future(again_and_again(ATTACKERS[name], target))
        for name, number in numbers.items()
        for _ in range(number)
    ]
    print("ready", flush=True)
    await over.wait()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    print(json.dumps(target.answers), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("attackers", nargs="+")
    parser.add_argument("--key", default="")
    parser.add_argument("--silent", default="SILENT")
    parser.add_argument("--loop", default="TIC-101")
    asked = parser.parse_args()
    os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    place = urlsplit(asked.url)
    target = Target(place.hostname or "", place.port or 80, asked.key, asked.silent, asked.loop)
    numbers = {name: int(number or 1) for name, _, number in (each.partition("=") for each in asked.attackers)}
    asyncio.run(attack(target, numbers))


if __name__ == "__main__":
    main()
