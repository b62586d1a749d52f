"""The door of a service that is really served, beside clients that mean harm: what they may not keep others from."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import httpx
import pytest

from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.security.keys import Scope
from loopwright.service.store.keyring import Keyring
from loopwright.service.store.store import Store
from tests.forked import ForkedProcess
from tests.unit.service.fakes import TAG
from tests.unit.service.gateway import HOME, read_loop

pytestmark = pytest.mark.timeout(300)  # processes that start slowly on a busy machine
SILENT = "SILENT"
NOT_BEHIND_S = 10.0
"""The requirement is 0.5 s. What a busy machine adds is not the service's doing: what is looked for here are the waits
behind others, of 20 s and more; the figures are printed."""


class Door:
    """A service with a loop under test, a loop whose node is silent, and attackers before its door."""

    def __init__(self, stack: ExitStack, folder: Path, auth: bool, **limits: Any) -> None:
        self._stack, self._folder = stack, folder
        folder.mkdir(exist_ok=True)
        self.key = self.stranger = self.guessed = ""
        if auth:
            with closing(Store(folder / "data")) as store:
                keyring = Keyring(store.engine)
                self.key, self.stranger, self.guessed = (
                    keyring.create(name, scope)[1]
                    for name, scope in (
                        ("operator", Scope.ADMIN), ("stranger", Scope.OPERATE), ("guessed", Scope.READ),
                    )
                )  # fmt: skip
        arguments = [str(folder), f"--tag={TAG}", f"--on-bus={SILENT}", f"--limits={json.dumps(limits)}"]
        self.process = ForkedProcess(
            "gateway", ("tests.unit.service.gateway", *arguments, *(["--auth"] if auth else [])), folder / "gateway.log"
        )
        stack.callback(self.process.stop)
        self.url = self.process.wait_ready(60).split()[1]
        self._headers = {"Authorization": f"Bearer {self.key}"} if auth else {}

    def ask(self, method: str, path: str, **more: Any) -> httpx.Response:
        """On a connection of its own, as a command at a console does: one that idles may be closed for another."""
        with httpx.Client(base_url=self.url, timeout=60.0, trust_env=False, headers=self._headers) as client:
            return client.request(method, path, **more)

    def attacked_by(self, *attackers: str, key: str = "") -> Callable[[], dict[str, int]]:
        """Begins; what is returned ends them, and says what they were answered."""
        log = self._folder / f"{attackers[0].partition('=')[0]}.log"
        arguments = ("tests.hostile.attackers", self.url, *attackers, f"--silent={SILENT}", f"--loop={TAG}")
        process = ChildProcess("attackers", (*arguments, *([f"--key={key}"] if key else [])), log)
        self._stack.callback(process.stop)
        process.wait_ready(60)

        def end() -> dict[str, int]:
            process.stop()
            # an attacker whose connection breaks as it ends may say so after its answers
            said = next(line for line in reversed(log.read_text().splitlines()) if line.startswith("{"))
            found: dict[str, int] = json.loads(said)
            return found

        return end

    def retune(self) -> str:
        """Asked for until it runs: its kind of work may be full, and its connection be closed for another. That of an
        abort may not."""
        found: list[str] = []

        def begun() -> bool:
            try:
                answer = self.ask("POST", f"/loops/{TAG}/retune", json={"by": "me"})
            except httpx.TransportError:
                return False
            assert answer.status_code in (202, 409, 429, 503), answer.text
            found.extend([answer.headers["location"]] if answer.status_code in (202, 409) else [])
            return bool(found)

        self.until(begun)
        self.until(lambda: (self._folder / f"{TAG}.json").exists() and read_loop(self._folder, TAG).on_trial)
        return found[0]

    def state(self, url: str) -> str | None:
        try:
            found: str | None = self.ask("GET", url).json().get("state")
        except httpx.TransportError:
            return None
        return found

    def until(self, wanted: Callable[[], bool], patience_s: float = 180.0) -> None:
        give_up = time.monotonic() + patience_s
        while not wanted():
            assert time.monotonic() < give_up
            time.sleep(0.01)

    def home(self) -> bool:
        return read_loop(self._folder, TAG) == HOME

    def lines(self) -> list[str]:
        return (self._folder / "gateway.log").read_text().splitlines()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def worst(times: list[tuple[float, int]], wanted: tuple[int, ...]) -> float:
    assert {status for _, status in times} <= set(wanted), times
    return max(seconds for seconds, _ in times)


@pytest.mark.parametrize("auth", [True, False], ids=["with keys", "without"])
def test_aborts_and_healthz_are_answered_at_once_beside_all_attacks(
    stack: ExitStack, tmp_path: Path, auth: bool
) -> None:
    attacked = time.monotonic()
    door = Door(stack, tmp_path, auth, body_s=3.0, headers_s=3.0)
    ends = [
        door.attacked_by("reads_of_a_silent_node=60", key=door.stranger),
        door.attacked_by("unfinished_bodies=64", "reads_of_the_database=4", key=door.stranger),
        door.attacked_by("idle_connections=400", "slow_heads=20"),
    ]
    if auth:
        ends.append(door.attacked_by("guesses_at_a_key=200", key=door.guessed))
    health, aborts, effects = [], [], []

    def timed(method: str, path: str) -> tuple[float, int]:
        began = time.monotonic()
        status = door.ask(method, path).status_code
        return time.monotonic() - began, status

    door.until(lambda: any("since the last such line" in line for line in door.lines()))  # the attackers are there
    for _ in range(3):
        url = door.retune()
        health += [timed("GET", "/healthz") for _ in range(3)]
        began = time.monotonic()
        aborts.append(timed("POST", f"{url}/abort"))
        door.until(door.home)
        effects.append(time.monotonic() - began)
        door.until(lambda url=url: door.state(url) == "aborted")
    answers: dict[str, int] = {}
    for end in ends:
        answers |= end()
    figures = {
        "abort_s": worst(aborts, (202,)), "in_effect_s": max(effects), "healthz_s": worst(health, (200,)),
    }  # fmt: skip
    print({name: round(value, 3) for name, value in figures.items()}, answers)
    assert max(figures.values()) < NOT_BEHIND_S, figures
    told = [line for line in door.lines() if "since the last such line" in line]
    assert len(told) <= 2 + (time.monotonic() - attacked) / 60.0
    assert door.process.poll() is None
