"""How fast the operators' page is and what it keeps, in Debian's Chromium, and what its viewers cost the service.

The service, the hubs and the page are real; the values come from a process that sends them as controllers do. Times of
script are times of the processor: what else runs on the machine does not count. Frames are counted on an empty page as
well, in turn with the page, for that shows what the machine itself holds up.

    python -m benchmarks.page
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page

from benchmarks.answers import answered_ms, p95
from benchmarks.command import command
from benchmarks.hour import STAND_IN, Kept, kept, metrics, pass_seconds, session_of
from benchmarks.page_site import RETUNED, Heard, chromium, live_messages, page_of
from loopwright.protocol.bus import open_bus
from loopwright.protocol.profile import TUNER_NODE, heartbeat_id
from loopwright.protocol.station import HEARTBEAT_S
from loopwright.service.cli.child_process import ChildProcess

FEW, RATE_PER_S = 10, 10.0
MANY, UPDATES = 500, 24
VIEWERS, ROUNDS, ASKED_PER_S = 50, 3, 20.0
VISITS = 5
FRAMES_S, TURNS = 10, 3
LATE_MS = 50.0
WARM_S, HALF_HOUR_S = 300, 1800
OVERVIEW = "/ui/"

ROWS_SEEN = """(() => {
  const look = () => {
    if (document.querySelector("tr.row .pvnum")) requestAnimationFrame(() => { window.rowsAt_ms = performance.now(); });
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})();"""
ROWS_COME = """() => new Promise((done) => {
  const look = () => window.rowsAt_ms ? done() : requestAnimationFrame(look);
  look();
})"""
"""The page's policy lets nothing evaluate a text again and again, as Playwright's wait_for_function does."""
FRAMES = """(ms) => new Promise((done) => {
  const found = [];
  let last = performance.now();
  const end = last + ms;
  const frame = () => {
    const now = performance.now();
    found.push(now - last);
    last = now;
    if (now < end) requestAnimationFrame(frame); else done(found);
  };
  requestAnimationFrame(frame);
})"""


def show_progress(what: str) -> None:
    print(f"  {what}", file=sys.stderr, flush=True)


def visits(browser: Browser, site: Heard) -> dict[str, Any]:
    """The first visits of browsers that have nothing, and the second ones."""
    first, again, sizes, requests = list[float](), list[float](), 0, 0
    for _ in range(VISITS):
        with page_of(browser, ROWS_SEEN) as page:
            session = page.context.new_cdp_session(page)
            session.send("Network.enable")
            received = list[float]()
            asked = list[str]()
            session.on("Network.loadingFinished", lambda found, to=received: to.append(found["encodedDataLength"]))
            session.on("Network.requestWillBeSent", lambda found, to=asked: to.append(found["request"]["url"]))
            first.append(_rows_ms(page, site))
            page.wait_for_load_state("load")
            sizes, requests = max(sizes, int(sum(received))), max(requests, len(asked))
            again.append(_rows_ms(page, site))
    return {
        "loops": len(site.tags), "bytes": sizes, "requests": requests,
        "rows_ms": statistics.median(first), "rows_worst_ms": max(first), "rows_again_ms": statistics.median(again),
    }  # fmt: skip


def _rows_ms(page: Page, site: Heard) -> float:
    """From the navigation to the frame after the first row, ms."""
    page.goto(f"{site.url}{OVERVIEW}")
    page.evaluate(ROWS_COME)
    return float(page.evaluate("window.rowsAt_ms"))


def frames(browser: Browser, site: Heard) -> dict[str, Any]:
    """Frames of the overview and of a loop's page, each in turn with those of an empty one."""
    found: dict[str, Any] = {"loops": len(site.tags)}
    for name, path, ready in (("overview", OVERVIEW, "tr.row"), ("loop", f"/ui/loops/{site.tags[0]}", ".u-over")):
        with page_of(browser) as page, page_of(browser) as empty:
            page.goto(f"{site.url}{path}")
            page.locator(ready).first.wait_for()
            session = session_of(page, "threadTicks")
            ours, nothing, script_s = list[float](), list[float](), 0.0
            for _ in range(TURNS):
                empty.bring_to_front()
                nothing += empty.evaluate(FRAMES, 1000 * FRAMES_S)
                page.bring_to_front()
                before = metrics(session)
                ours += page.evaluate(FRAMES, 1000 * FRAMES_S)
                script_s += metrics(session)["TaskDuration"] - before["TaskDuration"]
        found[name] = {
            "frames": len(ours), "late": _late(ours), "worst_ms": max(ours), "median_ms": statistics.median(ours),
            "empty_frames": len(nothing), "empty_late": _late(nothing), "empty_worst_ms": max(nothing),
            "share_of_a_core": script_s / (TURNS * FRAMES_S),
        }  # fmt: skip
        show_progress(f"{name}: {found[name]}")
    return found


def _late(deltas: list[float]) -> int:
    return sum(each > LATE_MS for each in deltas)


def updates(browser: Browser, site: Heard) -> dict[str, Any]:
    """What a second of the overview takes, in which one update of all rows comes, and in every third one the
    sparklines."""
    with page_of(browser) as page:
        page.goto(f"{site.url}{OVERVIEW}")
        page.locator("tr.row").nth(len(site.tags) - 1).wait_for(state="attached")
        session = session_of(page, "threadTicks")
        page.wait_for_timeout(6000)
        script, layout = list[float](), list[float]()
        before = metrics(session)
        for _ in range(UPDATES):
            page.wait_for_timeout(1000)
            now = metrics(session)
            script.append(1e3 * (now["ScriptDuration"] - before["ScriptDuration"]))
            layout.append(1e3 * sum(now[each] - before[each] for each in ("LayoutDuration", "RecalcStyleDuration")))
            before = now
    return {
        "loops": len(site.tags), "script_ms": statistics.median(script), "script_worst_ms": max(script),
        "layout_ms": statistics.median(layout), "layout_worst_ms": max(layout),
    }  # fmt: skip


def hour(browser: Browser, site: Heard) -> dict[str, Any]:
    """What the overview and a loop's page keep at the beginning, in the middle and at the end of an hour."""
    heard = live_messages(site.url)
    found: dict[str, Any] = {"loops": len(site.tags)}
    for name, path, ready in (("overview", OVERVIEW, "tr.row"), ("loop", f"/ui/loops/{site.tags[0]}", ".u-over")):
        with page_of(browser, STAND_IN) as page:
            session = session_of(page)
            page.goto(f"{site.url}{path}")
            page.locator("main").wait_for()
            began = time.monotonic()
            pass_seconds(page, WARM_S, heard)
            page.locator(ready).first.wait_for()
            state: list[Kept] = [kept(session)]
            for _ in range(2):
                pass_seconds(page, HALF_HOUR_S, heard)
                state.append(kept(session))
                show_progress(f"{name}: {state[-1]}")
        found[name] = {
            "heap_bytes": [each.heap for each in state], "nodes": [each.nodes for each in state],
            "listeners": [each.listeners for each in state], "took_s": time.monotonic() - began,
        }  # fmt: skip
    return found


class Heartbeats:
    """The heartbeats of the service on a bus: how late each comes after the one before, ms."""

    def __init__(self, url: str) -> None:
        self.late_ms: list[float] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, args=(url,))
        self._thread.start()

    def _listen(self, url: str) -> None:
        last: float | None = None
        with closing(open_bus(url)) as bus:
            bus.set_filters((heartbeat_id(TUNER_NODE),))
            while not self._over.is_set():
                if bus.recv(0.5) is not None:
                    now = time.monotonic()
                    if last is not None:
                        self.late_ms.append(1e3 * (now - last - HEARTBEAT_S))
                    last = now

    def taken(self) -> list[float]:
        found, self.late_ms = self.late_ms, []
        return sorted(found)

    def stop(self) -> None:
        self._over.set()
        self._thread.join()


def viewed(stack: ExitStack, folder: Path) -> dict[str, Any]:
    """What viewers of the overview cost who asks for a job, and the heartbeat of a test that runs: rounds take turns,
    without viewers and with them."""
    site = Heard(stack, folder, FEW, RATE_PER_S, retuned=True)
    site.until_heard()
    beats = Heartbeats(site.bus)
    stack.callback(beats.stop)
    body = {"by": "benchmark", "method": "five-stage"}
    asked = site.http.post(f"/loops/{RETUNED}/retune", json=body).raise_for_status()
    job = str(asked.headers["location"])
    while site.http.get(job).json()["stage"] is None:
        time.sleep(0.2)
    alone, beside = list[list[float]](), list[list[float]]()
    late: dict[str, list[list[float]]] = {"alone": [], "viewed": []}
    for n in range(ROUNDS):
        beats.taken()
        alone.append(answered_ms(site.url, [job], ASKED_PER_S))
        late["alone"].append(beats.taken())
        viewers = ChildProcess("viewers", ("benchmarks.viewers", site.url, str(VIEWERS)), folder / f"viewers-{n}.log")
        try:
            viewers.wait_ready()
            beats.taken()
            beside.append(answered_ms(site.url, [job], ASKED_PER_S))
            late["viewed"].append(beats.taken())
        finally:
            viewers.stop()
        show_progress(f"p95 {p95(alone[-1]):.1f} ms, with viewers {p95(beside[-1]):.1f} ms")
    state = site.http.get(job).json()["state"]
    site.http.post(f"{job}/abort", json={})
    if state != "running":
        raise RuntimeError(f"the test ended before the last round: {state}")
    ratios = [p95(after) / p95(before) for before, after in zip(alone, beside, strict=True)]
    return {
        "viewers": VIEWERS, "rate_per_s": ASKED_PER_S, "rounds": ROUNDS,
        "alone_p95_ms": statistics.median(map(p95, alone)),
        "viewed_p95_ms": statistics.median(map(p95, beside)), "ratio": statistics.median(ratios),
        "ratio_range": [min(ratios), max(ratios)],
        "heartbeat": {
            name: {"p95_ms": statistics.median(map(p95, rounds)), "worst_ms": max(map(max, rounds))}
            for name, rounds in late.items()
        },
    }  # fmt: skip


def measure() -> dict[str, Any]:
    with ExitStack() as stack:
        browser = stack.enter_context(chromium())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        found: dict[str, Any] = {}
        with ExitStack() as few:
            site = Heard(few, _made(folder / "few"), FEW, RATE_PER_S)
            site.until_heard()
            found["visits"] = visits(browser, site)
            show_progress(f"visits: {found['visits']}")
            found["frames"] = frames(browser, site)
            found["hour"] = hour(browser, site)
        with ExitStack() as many:
            site = Heard(many, _made(folder / "many"), MANY, 1.0)
            site.until_heard()
            found["updates"] = updates(browser, site)
            show_progress(f"updates: {found['updates']}")
        with ExitStack() as alone:
            found["viewers"] = viewed(alone, _made(folder / "viewed"))
        return found


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


if __name__ == "__main__":
    command(__doc__, measure)
