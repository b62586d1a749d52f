"""docs/faults.md from the results of the campaign."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.e2e.plantsite import STAGES
from tests.faults.cases import BOTH, FAULTS
from tests.faults.ending import Ending
from tests.faults.stand import LOOP, PACE, SMALL_DISK_MIB
from tests.faults.watch_cases import WATCH_FAULTS
from tests.faults.watch_ending import MOMENTS

TABLE = Path(__file__).parents[2] / "docs" / "faults.md"
MARK = " †"
FEW = 4
"""Ends of so many jobs at most have their stages named."""

HEAD = """# Every fault in every stage

A job is brought into a stage, then one fault is let loose on it. Plant, controller and service are real processes on
the loopback hub; the end of the loop is read from the controller by SDO, past the fault. Written by `make faults`.

**{runs} runs, {unsafe} unsafe endings, {active} jobs that stayed active, {defects} answers that no page describes.**
{dates}. `make faults` fails unless the last three numbers are 0.

An ending is unsafe unless mode and set-point are those found, the accepted gains are in effect, nothing is on trial,
no session is open, both nodes are operational, and MV at the plant is what the mode stands for: in automatic where the
loop rests, in manual the manual output found. What another node has chosen for itself during the job has the last
word. Unsafe ends and their jobs would stand here by name:{bad}

## How it ended

- *runs*: with SQLite, and with PostgreSQL behind the plus. A fault is tried in each stage of `five-stage`, `fast` and
  `setpoint`, and of pulses of the manual output (`manual-up`: the first pulse while MV is away; `manual-back`: as soon
  as MV is back; `manual-rest`: the second one when PV is left to itself); a few in some of these only.
- *how the jobs ended*: with the number of jobs, and the stages where they are few; behind a slash, the attempt in
  which it ended. `proposed`: the whole procedure came to its end in spite of the fault.
- *samples lost*: at most, of those from before the fault in the struck attempt, not stored.
- *safe after*: wall time from the fault until the controller was seen safe, at most; looked at every 0.1 s, through a
  fault of the bus too. A dash: every job kept its loop, and went on to its proposal.

The loop is model 14 of the 50, sampled at {ts:g} s, run at {pace:g} times real time, slower where a stage is short. A
run in which the machine itself stood still for 0.4 s is repeated, twice at most, unless its end is bad: the heartbeat
time is 1.5 s, and `session_ended_by_device` with no fault in sight is such a machine's.
"""

EARLIER = """
†: kept from a run before the last corrections of the product and of this harness; the next run replaces it.
"""

WATCH = """## Monitoring after acceptance

Gains are accepted, with the automatic rollback ([watch.md](watch.md)). A load that MV cannot
balance then takes PV out of its limits, and the previous gains are to be put back. A fault strikes

{moments}

The end is unsafe, too, where the loop has gains that nobody has decided on: those put back, those accepted, or those
that another hand has set; and where job, watch and alarms do not say the same of it. Each cell: what came of it, and
the wall time from the fault (in the first column with what goes wrong after it) until the watch had decided.

"""

TAIL = """## What the faults are

- A process that is killed or ends is started again at once, the controller with `--keep` and with gains in its options
  that are not the accepted ones: it must come back on the accepted ones.
- Faults of the bus hold for every frame of everybody, in the hub; losses, late answers and doubled frames last until
  the job ends. Senseless frames have wrong lengths, no number as set-point, unknown commands; 20 times each.
- Other gains: Kp 999, written and put on trial; the controller refuses the trial while its relay runs.
- The exception is raised by the check of the next sample in the service. The load, on the plant's input, takes PV over
  a limit of the job, and the controller is the one that has to end the session for it. Where the bus between
  controller and plant is down in a pulse, MV stays at the plant where the pulse has taken it, until the bus is back or
  the I/O reacts (2014h): therefore the 10 s of "bus down for 10 s".
- Disk full: the data folder is a file system of {disk} MiB, filled to its last byte.
- Database locked, or away with SQLite: `BEGIN EXCLUSIVE` on both files by another process; with PostgreSQL an
  exclusive lock on our tables, or the server stopped as by a power cut and started again.
- The back-up is made while the job runs, then the service is killed, the back-up restored (`loopwright restore`, which
  ends the job; `pg_restore`, after which it resumes unless the service is started with `--no-resume`), the service
  started.
- The wall clock is that of the service's Python, set back while the job runs; the machine's own is left alone.
- The clients read jobs, loops, events and samples, hang up in the middle of answers, and each wants the job aborted at
  some moment within 10 s.

`python -m tests.faults --faults service-killed,locked --stages relay --database sqlite` repeats a part. Every run,
with its stage, samples and times: `tests/faults/results.json`. A part of the table is in `make test`
(`tests/faults/test_endings.py`).
"""


def write(entries: Sequence[dict[str, Any]]) -> None:
    TABLE.write_text(text(entries), encoding="utf-8")


def text(entries: Sequence[dict[str, Any]]) -> str:
    """The page."""
    found = [(Ending(**{name: entry[name] for name in entry if name != "date"}), entry["date"]) for entry in entries]
    endings = [one for one, _ in found]
    dates = sorted({date for _, date in found})
    bad = "".join(f"\n- {one.database}, {one.fault}, {one.stage}: {_why(one)}" for one in endings if one.bad)
    head = HEAD.format(
        runs=len(endings),
        unsafe=sum(bool(one.unsafe) for one in endings),
        active=sum(one.active for one in endings),
        defects=sum(len(one.defects) for one in endings),
        dates=" to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "never run",
        bad=bad or " there are none.",
        ts=LOOP.ts,
        pace=PACE,
    )
    if any(one.earlier for one in endings):
        head += EARLIER
    moments = ";\n".join(f"- *{name}*: {words}" for name, words in MOMENTS.items()) + "."
    watch = _watch_table({(one.fault, one.stage): one for one in endings if one.database == BOTH[0]})
    return f"{head}\n{_table(endings)}\n{WATCH.format(moments=moments)}{watch}\n{TAIL.format(disk=SMALL_DISK_MIB)}"


def _table(endings: Sequence[Ending]) -> str:
    """One row a fault, over all its stages and both databases."""
    lines = _heading("fault", "runs", "the loop", "how the jobs ended", "samples lost", "safe after")
    for name, fault in FAULTS.items():
        row = [one for one in endings if one.fault == name and one.stage in STAGES]
        if not row:
            continue
        runs = " + ".join(str(n) for database in BOTH if (n := sum(one.database == database for one in row)))
        after = [one.safe_s for one in row if one.safe_s is not None]
        safe = f"{max(after):.1f} s" if after else "–"
        lost = max(one.lost for one in row)
        lines.append(f"| {fault.words} | {runs} | {_loops(row)} | {_ends(row)} | {lost} | {safe} |")
    return "\n".join(lines) + "\n"


def _ends(row: Sequence[Ending]) -> str:
    """The most frequent first."""
    stages = defaultdict(list)
    for one in row:
        stages[_end(one)].append(one.stage)
    if len(stages) == 1:
        return next(iter(stages))
    return "; ".join(
        f"{end}: {len(where)}" + (f" ({', '.join(dict.fromkeys(where))})" if len(where) <= FEW else "")
        for end, where in sorted(stages.items(), key=lambda each: -len(each[1]))
    )


def _end(one: Ending) -> str:
    end = one.state + (f", `{one.reason}`" if one.reason else "") + (f" / {one.attempts}" if one.attempts > 1 else "")
    return f"{'**BAD** ' if one.bad else ''}{end}{MARK if one.earlier else ''}"


def _watch_table(cells: Mapping[tuple[str, str], Ending]) -> str:
    lines = _heading("fault", "the loop", *MOMENTS)
    for name, fault in WATCH_FAULTS.items():
        row = [cells[name, moment] for moment in MOMENTS if (name, moment) in cells]
        if row:
            shown = [_watch_cell(cells.get((name, moment))) for moment in MOMENTS]
            lines.append(f"| {fault.words} | {_loops(row)} | {' | '.join(shown)} |")
    return "\n".join(lines) + "\n"


def _heading(*columns: str) -> list[str]:
    return [f"| {' | '.join(columns)} |", "|" + " --- |" * len(columns)]


def _loops(row: Iterable[Ending]) -> str:
    return " / ".join(dict.fromkeys("**unsafe**" if one.unsafe else one.loop for one in row))


def _watch_cell(one: Ending | None) -> str:
    if one is None:
        return ""
    bad = "**BAD** " if one.bad else ""
    if one.detail is not None:
        return f"{bad}not put back: {one.detail.partition(';')[0]}; {one.safe_s:.0f} s"
    return f"{bad}{(one.reason or one.state).replace('_', ' ')}; {one.safe_s:.0f} s"


def _why(one: Ending) -> str:
    return "; ".join([one.unsafe, *one.defects, "still active" if one.active else ""]).strip("; ").replace("\n", " ")
