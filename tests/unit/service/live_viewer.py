"""A viewer of the live stream, as a browser is one: it reads messages as they come."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import httpx


class LiveViewer:
    """Keeps what came. ids: of the events, in order."""

    def __init__(self, answer: httpx.Response) -> None:
        self.answer = answer
        self.messages: list[tuple[str, dict[str, Any]]] = []
        self.ids: list[str] = []
        self.comments: list[str] = []
        self._lines = answer.iter_lines()

    def read(self) -> bool:
        """One message or comment more; False: the stream is over."""
        name = ""
        for line in self._lines:
            if line.startswith(": "):
                self.comments.append(line[2:])
            elif line.startswith("id: "):
                self.ids.append(line[4:])
            elif line.startswith("event: "):
                name = line[7:]
            elif line.startswith("data: "):
                self.messages.append((name, json.loads(line[6:])))
            elif not line:
                return True
        return False

    def until(self, name: str, wanted: Callable[[dict[str, Any]], object] = lambda _: True) -> dict[str, Any]:
        """The next message of that name that is as wanted."""
        while True:
            seen = len(self.messages)
            assert self.read(), f"the stream ended before {name} came: {self.comments}"
            for each, message in self.messages[seen:]:
                if each == name and wanted(message):
                    return message

    def becomes(self, name: str, wanted: Callable[[dict[str, Any]], object]) -> None:
        """Reads until the latest message of that name, which may have come before, is as wanted."""
        while not wanted(next((message for each, message in reversed(self.messages) if each == name), {})):
            assert self.read(), f"the stream ended before {name} came: {self.comments}"

    def row(self, tag: str, wanted: Callable[[dict[str, Any]], object] = lambda _: True) -> dict[str, Any]:
        """The row of a loop, once it is as wanted."""

        def of(message: dict[str, Any]) -> dict[str, Any]:
            return next(row for row in message["loops"] if row["tag"] == tag)

        return of(self.until("loops", lambda message: wanted(of(message))))

    def rest(self) -> None:
        """Reads until the stream ends."""
        while self.read():
            pass


@contextmanager
def viewing(base: str, path: str = "/live", **headers: str) -> Iterator[LiveViewer]:
    with (
        httpx.Client(base_url=base, timeout=60.0, trust_env=False) as client,
        client.stream(
            "GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()}
        ) as answer,
    ):
        assert answer.status_code == 200, answer.read()
        yield LiveViewer(answer)
