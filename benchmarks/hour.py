"""An hour of the live stream in a page within a minute or so, and what the page keeps of it.

The page is the real one, from a real service, which answers its requests. In place of its EventSource is a stand-in
that is given messages as this service has just sent them, with later times and other values; the page's clock and its
intervals go on by the time that the messages say has passed. A request that is under way is waited for, so that they
do not pile up as they would not in an hour. What is read from a controller is asked for once and answered again: there
is none here, and each time its silence would be waited for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from playwright.sync_api import CDPSession, Page

STAND_IN = r"""(() => {
  const asking = new Set();
  let ahead_ms = 0, intervals = [], number = 0, source = null;
  const now = Date.now, since = performance.now.bind(performance), ask = window.fetch.bind(window);
  Date.now = () => now() + ahead_ms;
  performance.now = () => since() + ahead_ms;
  window.setInterval = (call, ms) => {
    intervals.push({ id: ++number, call, ms, due: performance.now() + ms });
    return number;
  };
  window.clearInterval = (id) => { intervals = intervals.filter((each) => each.id !== id); };
  const read = /\/loops\/[^/?]+(\/retune\/preview)?$/, first = new Map();
  const answered = (...asked) => {
    const url = String(asked[0]);
    if (!read.test(url)) return ask(...asked);
    if (!first.has(url)) first.set(url, ask(...asked));
    return first.get(url).then((answer) => answer.clone());
  };
  window.fetch = (...asked) => {
    const answer = answered(...asked);
    const over = answer.then(() => {}, () => {}).finally(() => asking.delete(over));
    asking.add(over);
    return answer;
  };
  window.EventSource = class extends EventTarget {
    constructor(url) {
      super();
      this.tag = new URL(url, location.href).searchParams.get("loops");
      source = this;
    }
    close() { if (source === this) source = null; }
  };
  const send = (name, message) => source?.dispatchEvent(new MessageEvent(name, { data: JSON.stringify(message) }));
  const channel = new MessageChannel(), waiting = [];
  channel.port1.onmessage = () => waiting.shift()();
  const turn = () => new Promise((done) => { waiting.push(done); channel.port2.postMessage(null); });
  let n = 0;
  const pv = (at_s, loop) => 50 + Math.sin(at_s / (3 + loop % 7));
  const job = (heard, tag, s) => s % 300 < 60 ? [{ id: "0123456789ab", url: "/jobs/0123456789ab", loop: tag,
    gateway: heard.hello.gateway, state: "running", dry_run: true, by: "bench", stage: "relay",
    progress: (s % 300) / 60, remaining_plant_time_s: 60 - s % 300, plant_time_s: s % 300, stopping: false }] : [];
  window.passSeconds = async (seconds, heard) => {
    for (let s = 0; s < seconds; s++) {
      for (let tenth = 0; tenth < 10; tenth++) {
        ahead_ms += 100;
        const at_s = Date.now() / 1000;
        if (tenth === 0) {
          if (!n) { send("hello", { ...heard.hello, now_s: at_s }); send("buses", heard.buses); }
          send("loops", { now_s: at_s, loops: heard.loops.loops.map((row, k) => ({ ...row, pv: pv(at_s, k), sp: 50,
            mv: 50 + k % 9, mode: "automatic", age_s: 0.05, no_data: null })) });
          send("jobs", { jobs: job(heard, heard.loops.loops[0].tag, s) });
        }
        n++;
        if (source?.tag) send("samples", { tag: source.tag, past: false, n: [n], at_s: [at_s], sp: [50],
          pv: [pv(at_s, 0)], mv: [50 + n % 9], mode: [2], gap_before: [] });
        for (const each of [...intervals]) {
          if (performance.now() >= each.due) { each.due += each.ms; each.call(); }
        }
        await turn();
      }
      await new Promise(requestAnimationFrame);
      while (asking.size > 0) { await Promise.all(asking); await turn(); }
    }
  };
})();"""
"""What runs in the page before its own scripts. The page's clock goes faster only within `passSeconds`."""
AT_ONCE_S = 60


@dataclass(frozen=True)
class Kept:
    """What a page keeps after a collection. heap: bytes of the JavaScript heap."""

    heap: int
    nodes: int
    listeners: int


def pass_seconds(page: Page, seconds: int, heard: dict[str, Any]) -> None:
    """So much time passes in a page that has the stand-in. heard: messages of the live stream, by kind."""
    for _ in range(0, seconds, AT_ONCE_S):
        page.evaluate("([seconds, heard]) => passSeconds(seconds, heard)", [min(seconds, AT_ONCE_S), heard])


def session_of(page: Page, time_domain: str = "timeTicks") -> CDPSession:
    """Chromium's protocol, with what it counts. time_domain: threadTicks counts times of the processor."""
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable", {"timeDomain": time_domain})
    return session


def metrics(session: CDPSession) -> dict[str, float]:
    return {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}


def kept(session: CDPSession) -> Kept:
    """Twice collected, for what the first collection frees may have held others."""
    for _ in range(2):
        session.send("HeapProfiler.collectGarbage")
    found = metrics(session)
    return Kept(int(found["JSHeapUsedSize"]), int(found["Nodes"]), int(found["JSEventListeners"]))
