"""Brings each fault into each stage of a live job, and writes down how job and loop ended."""

from __future__ import annotations

import json
import math
import multiprocessing
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

from loopwright.protocol.real32 import nearest
from tests.e2e.plantsite import STAGES, Stage
from tests.faults.ending import Ending, unsafe
from tests.faults.faulty_hub import FaultyHub
from tests.faults.stand import LOOP, Missing, Stand, StoredSample
from tests.faults.watch_cases import ALL_FAULTS
from tests.faults.watch_ending import MOMENTS, watch_ending

HOME_WITHIN_S = 6.0
"""After the end of a job that could not restore its loop: heartbeat or lease runs out, the law brings MV to rest."""
OVER_WITHIN_S = 300.0
"""A job that is still active then is one for ever."""
STALL_S = 0.4
"""A machine that stands still so long may itself cost a job its session (a fast loop loses samples): what comes of the
fault is looked for again, but for a bad end, which stands."""
REPEATS = 2
BEGUN_WITHIN = 200
"""Samples after the opening of a session within which the first one is stored."""
RESULTS = Path(__file__).with_name("results.json")


def ending(stand: Stand, name: str, stage: str, database: str = "sqlite") -> Ending:
    """One fault in one stage."""
    fault = ALL_FAULTS[name]
    if stage in MOMENTS:
        return watch_ending(stand, name, fault.inject, stage, database)
    where = STAGES[stage]
    began = time.monotonic()
    url = _brought_into(stand, where)
    struck_at, struck = stand.hub.answered, time.monotonic()
    with stand.eye.watching(stand.home) as safe, fault.inject(stand, url) as other:
        job = _over(stand, url)
        home = other or stand.home
        last = stand.eye.settled(home, HOME_WITHIN_S)
    if last is not None and not unsafe(last, home):
        safe.append(last.at)
    safe_s = min(safe, default=math.nan) - struck
    went_on = job["attempts"] == 1 and job["state"] == "proposed"
    kept, lost, missing = _samples(stand, url, struck_at)
    return Ending(
        database, name, stage, job["state"], job["reason"], job["detail"], job["attempts"],
        None if went_on or math.isnan(safe_s) else round(safe_s, 1),
        kept, lost, missing, unsafe(last, home, at_rest=True), home.words, list(stand.defects),
        round(time.monotonic() - began, 1), round(stand.stalls.longest_s, 2),
    )  # fmt: skip


def calm_ending(stand: Stand, name: str, stage: str, database: str = "sqlite") -> Ending:
    """The same, repeated while the machine itself stands still."""
    one = ending(stand, name, stage, database)
    for _ in range(REPEATS):
        if one.bad or one.stall_s < STALL_S:
            break
        print(f"repeated, the machine stood still for {one.stall_s:.1f} s: {line(one)}", flush=True)
        one = ending(stand, name, stage, database)
    return one


def _brought_into(stand: Stand, stage: Stage) -> str:
    """The URL of a job in that stage. A busy machine alone can end a job: then it is tried again."""
    for last_try in (False, False, True):
        try:
            return stand.in_stage(stage)
        except AssertionError as error:
            if last_try:
                raise
            print(f"before any fault, tried again: {error}", flush=True)
    raise AssertionError


def _over(stand: Stand, url: str) -> dict[str, Any]:
    try:
        return stand.site.finished(url, OVER_WITHIN_S)
    except AssertionError:
        job = stand.site.job(url)
        stand.site.http.post(f"{url}/abort")
        return job


def _samples(stand: Stand, url: str, struck_at: int) -> tuple[int, int, int]:
    """Counts the samples of the attempt that was struck after the sample of that number: how many until then are
    stored, how many after the last of them are not, and how many never came over the bus, between two that did."""
    stored = stand.left
    if stored is None:
        job = stand.site.http.get(f"{url}/samples").json()
        stored = [
            StoredSample(round(t / LOOP.ts), pv, mv) for t, pv, mv in zip(job["t_s"], job["pv"], job["mv"], strict=True)
        ]
    first = _first_number(stand.hub, stored)
    numbers = [first + sample.number for sample in stored]
    before = [number for number in numbers if number <= struck_at]
    missing = sum(b - a - 1 for a, b in pairwise(numbers))
    return len(before), struck_at - max(before, default=first - 1), missing


def _first_number(hub: FaultyHub, stored: Sequence[StoredSample]) -> int:
    """Returns the number that the first stored sample had on the bus. The service begins to store some samples after
    the opening of its session: how many, the values of PV and MV tell, and which samples are missing. Raises
    AssertionError where they never fit."""
    for first in range(hub.first_of_session, hub.first_of_session + BEGUN_WITHIN):
        if all(
            pv is None or mv is None or (nearest(pv), nearest(mv)) in hub.samples.get(first + number, ())
            for number, pv, mv in stored
        ):
            return first
    raise AssertionError("the stored samples are not those of the bus")


def run(faults: Sequence[str], stages: Sequence[str], databases: Sequence[str], at_once: int) -> Iterator[list[Ending]]:
    """The rows (a fault on a database each), each on a stand of its own, a few at a time. Prints as it goes."""
    rows = [
        (name, database, [stage for at, stage in ALL_FAULTS[name].runs() if at == database and stage in stages])
        for database in databases
        for name in faults
        if database in ALL_FAULTS[name].databases
    ]
    # The longest first: the last ones then end at about the same time.
    rows.sort(key=lambda row: -len(row[2]) * (2 if ALL_FAULTS[row[0]].needs.small_disk or row[0] == "away" else 1))
    with ProcessPoolExecutor(at_once, multiprocessing.get_context("spawn")) as pool:
        for done in as_completed([pool.submit(_row, *row) for row in rows if row[2]]):
            yield done.result()


def _row(name: str, database: str, stages: Iterable[str]) -> list[Ending]:
    found: list[Ending] = []

    def add(one: Ending) -> None:
        found.append(one)
        print(line(one), flush=True)

    waiting = list(stages)
    while waiting:
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="loopwright-faults-")))
            try:
                stand = Stand(stack, folder, database, ALL_FAULTS[name].needs)
                while waiting:
                    one = calm_ending(stand, name, waiting[0], database)
                    add(one)
                    waiting.pop(0)
            except Missing as missing:
                add(_none(database, name, waiting.pop(0), f"needs {missing}"))
            except Exception:
                # The harness or the product: either way this is no end that we know to be safe.
                words = traceback.format_exc(limit=-3) + _logs(folder)
                add(_none(database, name, waiting.pop(0), words))
    return found


def _none(database: str, name: str, stage: str, why: str) -> Ending:
    return Ending(database, name, stage, "not known", None, None, 0, None, 0, 0, 0, "", "not known", [why])


def _logs(folder: Path) -> str:
    last = {log.name: log.read_text(errors="replace").strip().splitlines()[-3:] for log in folder.glob("*.log")}
    return f"\nlogs: {json.dumps(last)}"


def line(one: Ending) -> str:
    bad = f"  BAD: {one.unsafe or one.defects or 'still active'}" if one.bad else ""
    safe = "-" if one.safe_s is None else f"{one.safe_s:.1f} s"
    return (
        f"{one.database:<11}{one.fault:<18}{one.stage:<20}{one.state} {one.reason or ''} "
        f"({one.attempts}), {one.kept} kept, {one.lost} lost, {one.missing} missing, "
        f"safe in {safe}, took {one.took_s:.0f} s{bad}"
    )


def merge(found: Iterable[Ending], date: str) -> list[dict[str, Any]]:
    """Puts these in the place of what RESULTS had for the same fault, stage and database."""
    known = {tuple(entry[name] for name in ("database", "fault", "stage")): entry for entry in load()}
    known |= {one.key: asdict(one) | {"date": date} for one in found}
    rank = {name: n for n, name in enumerate(ALL_FAULTS)}
    stages = {name: n for n, name in enumerate((*STAGES, *MOMENTS))}
    order = sorted(
        (entry for entry in known.values() if entry["fault"] in rank and entry["stage"] in stages),
        key=lambda entry: (entry["database"] != "sqlite", rank[entry["fault"]], stages[entry["stage"]]),
    )
    RESULTS.write_text("[\n" + ",\n".join(json.dumps(entry) for entry in order) + "\n]\n", encoding="utf-8")
    return order


def load() -> list[dict[str, Any]]:
    return list(json.loads(RESULTS.read_text(encoding="utf-8"))) if RESULTS.exists() else []
