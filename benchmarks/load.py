"""Fifty loops of one bus retuned at the same time by the real service, by either procedure: time and memory.

Plant, controller and service are processes as a user starts them; one plant and one controller node carry all loops.
The data folder is in memory: under user-mode Linux every write to a disk would hold the whole guest up. What the
writes cost is a row of `benchmarks.engine`. Needs vcan0:

    tools/with-vcan -- .venv/bin/python -m benchmarks.load
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import yaml

from benchmarks.answers import memory_MB, processor_s
from benchmarks.bus import URL, device_samples_per_s, devices
from benchmarks.command import command
from loopwright.plantsim.catalogue import find
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.protocol.tuner import Tuner
from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.states.job_state import ACTIVE

TS = 0.1
MANY, PACE = 50, 1.0
FEW = {1: 10.0, 10: 5.0}
"""Loops for the memory of few of them, and the pace of their plant, times real time."""
START_S = 300.0
MODELS = (18, 29, 12, 14)
"""Of the 50, the quickest to retune; they take about as long as each other, so that all are under test to the end."""
FRACTION_OF_KU, FRACTION_OF_PU = 0.3, 0.8
LISTEN_S = 5.0
REQUESTS: dict[str, dict[str, Any]] = {
    "five-stage": {"method": "five-stage"},
    # the gains of some of these loops are as good as asked, and every test is to go to its end
    "fast": {"method": "fast", "propose_anyway": True},
}


def progress(what: str) -> None:
    print(f"  {what}", file=sys.stderr, flush=True)


class Site:
    """The three processes with so many loops."""

    def __init__(self, stack: ExitStack, folder: Path, loops: int, pace: float) -> None:
        self.loops = loops
        entries: list[dict[str, Any]] = []
        gains: list[dict[str, Any]] = []
        plants: list[str] = []
        for n in range(loops):
            name = f"model-{MODELS[n % len(MODELS)]}"
            facts = find(name).facts
            assert facts.Ku_on_bus and facts.Pu_s and facts.T95_s and facts.static_gain
            step = 5.0 * facts.static_gain / facts.mv_per_unit  # of the set-point: MV moves by 5 percent
            entries.append({
                "tag": f"T-{n}", "bus": URL, "controller_node": CONTROLLER_NODE, "plant_node": PLANT_NODE,
                "channel": n + 1, "pv_unit": "unit", "pv_limits": {"low": 50 - 10 * step, "high": 50 + 10 * step},
                "t95_s": facts.T95_s, "sp_deviation": step,
            })  # fmt: skip
            gains.append({"kp": FRACTION_OF_KU * facts.Ku_on_bus, "ti": FRACTION_OF_PU * facts.Pu_s, "sp": 50.0})
            plants.append(f"--model={name}")
        folder.mkdir()
        site = {"loops": entries, "buses": {URL: {"at_once": loops}}}
        (folder / "loops.yaml").write_text(yaml.safe_dump(site))
        (folder / "channels.yaml").write_text(yaml.safe_dump(gains))
        common = ("--bus", URL, "--ts", str(TS))
        where = ("--loops", str(folder / "loops.yaml"), "--data", str(folder / "data"), "--port", "0")
        arguments = {
            "controller": ("loopwright.controller", *common, "--config", str(folder / "channels.yaml")),
            "plant": ("loopwright.plantsim", *common, *plants, "--speed", str(pace)),
            "service": ("loopwright.service", "serve", *where),
        }
        for name, line in arguments.items():
            process = ChildProcess(name, line, folder / f"{name}.log")
            stack.callback(process.stop)
            self.url = process.wait_ready(START_S).split()[1]
        self.service = process
        self.http = stack.enter_context(httpx.Client(base_url=self.url, timeout=60.0, trust_env=False))

    def retune_all(self, method: str) -> list[str]:
        asked = REQUESTS[method] | {"by": "benchmark"}
        answers = [self.http.post(f"/loops/T-{n}/retune", json=asked).raise_for_status() for n in range(self.loops)]
        return [answer.headers["location"] for answer in answers]

    def until_over(self, urls: list[str], patience_s: float) -> tuple[list[dict[str, Any]], float]:
        """The jobs as they ended, and the largest memory seen meanwhile. It looks seldom: it is not to be the load."""
        give_up, maximum, ended = time.monotonic() + patience_s, 0.0, []
        while urls:
            job = self.http.get(urls[0]).json()
            if job["state"] not in tuple(ACTIVE):
                ended.append(job)
                urls = urls[1:]
                continue
            maximum = max(maximum, memory_MB(self.service.pid))
            if time.monotonic() > give_up:
                raise RuntimeError(f"{len(urls)} jobs have not ended in {patience_s:g} s")
            time.sleep(0.5)
        return ended, maximum


def retuned(folder: Path, loops: int, pace: float, method: str = "five-stage") -> dict[str, Any]:
    """All loops at once, from asking for the first to the end of the last."""
    with ExitStack() as stack:
        site = Site(stack, folder, loops, pace)
        began, before = time.monotonic(), processor_s(site.service.pid)
        jobs, maximum = site.until_over(site.retune_all(method), 600.0)
        wall, processor = time.monotonic() - began, processor_s(site.service.pid) - before
    ends = Counter(job["reason"] or job["state"] for job in jobs)
    longest = max(job["plant_time_s"] for job in jobs)
    progress(f"{method}: {loops} loops at {pace:g} times real time: {wall:.1f} s, {dict(ends)}")
    if not longest:
        raise RuntimeError(f"none of {loops} tests came to the end of a stage: {dict(ends)}")
    return {
        "method": method,
        "loops": loops,
        "pace": pace,
        "processor_s": processor,
        "wall_s": wall,
        "longest_plant_s": longest,
        "of_plant_time": wall * pace / longest,
        "proposed": ends["proposed"],
        "ends": dict(ends),
        "memory_MB": maximum,
    }


def heard_per_s(loops: int) -> float:
    """Samples/s of each loop that as many bare listeners in one process take of a plant that runs freely: what the
    processor leaves when a tuner does nothing but listen and beat."""
    over, heard = threading.Event(), [0] * loops

    def listen(at: int) -> None:
        tuner = Tuner(URL, CONTROLLER_NODE, PLANT_NODE, at + 1)
        tuner.beating = True
        while not over.is_set():
            if tuner.sample(0.2) is not None:
                heard[at] += 1
        tuner.close()

    with devices(loops, "max"):
        threads = [threading.Thread(target=listen, args=(at,)) for at in range(loops)]
        for thread in threads:
            thread.start()
        time.sleep(1.0)
        first, began = sum(heard), time.monotonic()
        time.sleep(LISTEN_S)
        rate = (sum(heard) - first) / (time.monotonic() - began) / loops
        over.set()
        for thread in threads:
            thread.join()
    return rate


def run() -> dict[str, Any]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as temporary:
        folder = Path(temporary)
        alone, heard = TS * device_samples_per_s(MANY), TS * heard_per_s(MANY)
        progress(f"devices alone {alone:.1f} times real time, {MANY} listeners {heard:.1f}")
        few = [retuned(folder / f"{loops}", loops, pace) for loops, pace in FEW.items()]
        many = retuned(folder / "many", MANY, PACE)
        fast = retuned(folder / "fast", MANY, PACE, "fast")
        return {
            "vcan": os.environ.get("LOOPWRIGHT_VCAN", "host"),
            "devices_alone": alone,
            "listeners": heard,
            "retunes": [*few, many],
            "fast": fast,
            "MB_per_loop": (many["memory_MB"] - few[0]["memory_MB"]) / (MANY - few[0]["loops"]),
        }


if __name__ == "__main__":
    command(__doc__, run)
