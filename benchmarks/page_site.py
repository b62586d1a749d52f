"""What the page is measured on: the real service, which hears so many loops on hubs, and Debian's Chromium."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import yaml
from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

from benchmarks.command import Missing
from loopwright.service.cli.child_process import ChildProcess

ON_A_HUB = 150
RETUNED = "TIC-1"
OPTIONS = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking")
SIZE = ViewportSize(width=1440, height=900)
START_S = 180.0
PATIENCE_MS = 120_000


class Heard:
    """A service whose loops are heard and have no controller that answers: what the page shows is real, except that
    nothing can be retuned.

    loops: how many.  rate_per_s: samples of each.  retuned: whether there is one more, RETUNED, with a plant and a
    controller in real time, on the bus `bus`.
    """

    def __init__(self, stack: ExitStack, folder: Path, loops: int, rate_per_s: float, retuned: bool = False) -> None:
        self._stack, self._folder = stack, folder
        entries: list[dict[str, Any]] = []
        for first in range(0, loops, ON_A_HUB):
            number = min(ON_A_HUB, loops - first)
            bus = self._run(f"hub-{first}", "loopwright.protocol.hub", "--port", "0").split()[1]
            self._run(f"broadcast-{first}", "benchmarks.broadcast", bus, str(number), str(rate_per_s))
            entries += [entry(first + n, bus, n + 1) for n in range(number)]
        self.tags = [str(each["tag"]) for each in entries]
        if retuned:
            self.bus = self._run("hub", "loopwright.protocol.hub", "--port", "0").split()[1]
            common = ("--bus", self.bus, "--ts", "0.1")
            self._run("controller", "loopwright.controller", *common, "--kp", "20", "--ti", "12", "--sp", "50")
            self._run("plant", "loopwright.plantsim", *common, "--model", "model-41", "--speed", "1")
            limits = {"pv_limits": {"low": 49.0, "high": 51.0}, "t95_s": 25.0, "sp_deviation": 0.1}
            entries.append(entry(loops, self.bus, 1) | limits | {"tag": RETUNED})
        (folder / "loops.yaml").write_text(yaml.safe_dump({"loops": entries}))
        where = ("--loops", str(folder / "loops.yaml"), "--data", str(folder / "data"), "--port", "0")
        self.url = self._run("service", "loopwright.service", "serve", *where).split()[1]
        self.http = httpx.Client(base_url=self.url, timeout=60.0, trust_env=False)
        stack.callback(self.http.close)

    def until_heard(self) -> None:
        """Waits until the service has a value of each loop."""
        give_up = time.monotonic() + START_S
        while any(row["pv"] is None for row in live_messages(self.url)["loops"]["loops"]):
            if time.monotonic() > give_up:
                raise RuntimeError("the service does not hear the loops")
            time.sleep(0.5)

    def _run(self, name: str, *arguments: str) -> str:
        process = ChildProcess(name, arguments, self._folder / f"{name}.log")
        self._stack.callback(process.stop)
        return process.wait_ready(START_S)


def live_messages(url: str) -> dict[str, Any]:
    """The first messages of a service's live stream, by kind."""
    found: dict[str, Any] = {}
    kind = ""
    with httpx.stream("GET", f"{url}/live", timeout=60.0, trust_env=False) as answer:
        for line in answer.iter_lines():
            if line.startswith("event: "):
                kind = line.removeprefix("event: ")
            elif line.startswith("data: "):
                found[kind] = json.loads(line.removeprefix("data: "))
            if all(each in found for each in ("hello", "loops", "buses")):
                return found
    raise RuntimeError(f"the live stream ended with {', '.join(found)}")


def entry(number: int, bus: str, channel: int) -> dict[str, Any]:
    """Such a loop in loops.yaml."""
    return {
        "tag": f"TIC-{number + 101}", "description": f"Jacket of reactor {number + 1}", "bus": bus, "channel": channel,
        "area": f"Area {number // 50 + 1}", "controller_node": 0x20, "plant_node": 0x10, "pv_unit": "degC",
        "pv_limits": {"low": 45.0, "high": 55.0}, "t95_s": 30.0, "sp_deviation": 0.5,
    }  # fmt: skip


@contextmanager
def chromium() -> Iterator[Browser]:
    """Debian's Chromium. Raises Missing."""
    path = shutil.which("chromium")
    if path is None:
        raise Missing("chromium is not installed")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=OPTIONS)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def page_of(browser: Browser, script: str = "") -> Iterator[Page]:
    """A page of a browser that has nothing cached. script: runs in it before the page's own."""
    context = browser.new_context(viewport=SIZE)
    context.set_default_timeout(PATIENCE_MS)
    if script:
        context.add_init_script(script)
    try:
        yield context.new_page()
    finally:
        context.close()
