"""docs/faults.md from the results of the campaign."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.e2e.plantsite import STAGES
from tests.faults.cases import BOTH, FAULTS, Fault
from tests.faults.ending import Ending
from tests.faults.stand import LOOP, PACE, SMALL_DISK_MIB
from tests.faults.watch_cases import WATCH_FAULTS
from tests.faults.watch_ending import MOMENTS

TABLE = Path(__file__).parents[2] / "docs" / "faults.md"
MARK = " †"
NAMES = {"sqlite": "SQLite, a file in the data folder", "postgresql": "PostgreSQL"}

HEAD = """# Every fault in every stage

Written by `make faults`. Real processes (plant, controller, service) on the loopback hub; a job is brought into a
stage, then one fault is let loose on it. The end of the loop is read from the controller by SDO, past the fault.

**{runs} runs, {unsafe} unsafe endings, {active} jobs that stayed active, {defects} answers that no page describes.**
{dates}. `make faults` fails unless the last three numbers are 0.

An ending is unsafe unless mode and set-point are those found, the accepted gains are in effect, nothing is on trial,
no session is open, both nodes are operational, and MV at the plant is what the mode stands for: in automatic where the
loop rests, in manual the manual output found. What another node has chosen for itself during the job has the last word.
Unsafe ends and their jobs would stand here by name:{bad}

## How to read it

Each cell: how the job ended (from the second attempt on, the number of the attempt), then

- of the samples of the struck attempt: how many from before the fault are stored (*kept*); where there are such, how
  many from before it are not (*lost*), and how many never came over the bus (*missing*: a plant whose sample nobody has
  answered goes on after 0.1 s);
- wall time from the fault until the controller was seen safe (looked at every 0.1 s, through a fault of the bus too).
  A dash: the job kept the loop, and went on to its proposal.

The loop is model 14 of the 50, sampled at {ts:g} s, run at {pace:g} times real time, slower where a stage is short.
*proposed* means that the whole procedure came to its end in spite of the fault. What is tried in some stages only does
not hang on the stage, or is there for a loop in manual, and pulses of its manual output: `manual-up` is the first pulse
while MV is away, `manual-back` the same one as soon as MV is back, `manual-rest` the second one when PV is left to
itself. A run in which the machine itself stood still for 0.4 s is repeated, twice at most, unless its end is bad: the
heartbeat time is 1.5 s, and `session_ended_by_device` with no fault in sight is such a machine's.
"""

EARLIER = """
†: kept from a run before the last corrections of the product and of this harness; the next run replaces it.
"""

WATCH = """## The watch after acceptance

Gains are accepted, with "put the previous gains back automatically" ([watch.md](watch.md)). A load that MV cannot
balance then takes PV out of its limits, and the previous gains are to be put back. A fault strikes

{moments}

The end is unsafe, too, where the loop has gains that nobody has decided on: those put back, those accepted, or those
that another hand has set; and where job, watch and alarms do not say the same of it. Each cell: what came of it, and
the wall time from the fault (in the first column with what goes wrong after it) until the watch had decided.

"""

TAIL = """## What the faults are

- A process that is killed or ends is started again at once, as a supervisor would, the controller with `--keep` and
  with gains in its options that are not the accepted ones: it must come back on the accepted ones.
- The bus and its frames: every frame of everybody, from the hub. Random losses, late answers and doubled frames last
  until the job ends. Senseless frames: wrong lengths, not a number as set-point, unknown commands; 20 times each.
- Other gains: Kp 999, written and put on trial; the controller refuses the trial while its relay runs.
- The exception is raised by the check of the next sample in the service. The load, on the plant's input, takes PV over
  a limit of the job, and the controller is the one that has to end the session for it. Where the bus between controller
  and plant is down in a pulse, MV stays at the plant where the pulse has taken it, until the bus is back or the I/O
  reacts (2014h): therefore the 10 s in the row "bus down for 10 s".
- Disk full: the data folder is a file system of {disk} MiB, filled to its last byte.
- Database locked, or away with SQLite: `BEGIN EXCLUSIVE` on both files by another process's connection; with PostgreSQL
  an exclusive lock on our tables, or the server stopped as by a power cut and started again.
- The back-up is made while the job runs, then the service is killed, the back-up restored (`loopwright restore`, which
  ends the job; `pg_restore`, after which it resumes unless the service is started with `--no-resume`), the service
  started.
- The wall clock is that of the service's Python (`time.time`, `datetime.now`), set back while the job runs; the
  machine's own is left alone.
- The clients read jobs, loops, events and samples, hang up in the middle of answers, and each wants the job aborted at
  some moment within 10 s.

Repeat a part, or one cell: `python -m tests.faults --faults service-killed,locked --stages relay --database sqlite`; it
takes its place in the table. Every run: `tests/faults/results.json`. A part of the table is in `make test`
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
    tables = "\n".join(_table(NAMES[database], FAULTS, tuple(STAGES), database, endings, _cell) for database in BOTH)
    moments = ";\n".join(f"- *{name}*: {words}" for name, words in MOMENTS.items()) + "."
    watch = _table("", WATCH_FAULTS, tuple(MOMENTS), BOTH[0], endings, _watch_cell)
    return f"{head}\n{tables}\n{WATCH.format(moments=moments)}{watch}\n{TAIL.format(disk=SMALL_DISK_MIB)}"


def _table(
    title: str,
    faults: Mapping[str, Fault],
    stages: Sequence[str],
    database: str,
    endings: Iterable[Ending],
    cell: Callable[[Ending | None], str],
) -> str:
    cells = {(one.fault, one.stage): one for one in endings if one.database == database}
    columns = ("fault", "loop", *stages)
    lines = [f"## {title}", ""] if title else []
    lines += [f"| {' | '.join(columns)} |", "|" + " --- |" * len(columns)]
    for name, fault in faults.items():
        row = [cells[name, stage] for stage in stages if (name, stage) in cells]
        if row:
            loop = " / ".join(dict.fromkeys("**unsafe**" if one.unsafe else one.loop for one in row))
            shown = [cell(cells.get((name, stage))) for stage in stages]
            lines.append(f"| {fault.words} | {loop} | {' | '.join(shown)} |")
    return "\n".join(lines) + "\n"


def _watch_cell(one: Ending | None) -> str:
    if one is None:
        return ""
    bad = "**BAD** " if one.bad else ""
    if one.detail is not None:
        return f"{bad}not put back: {one.detail.partition(';')[0]}; {one.safe_s:.0f} s"
    return f"{bad}{(one.reason or one.state).replace('_', ' ')}; {one.safe_s:.0f} s"


def _cell(one: Ending | None) -> str:
    if one is None:
        return ""
    end = one.state + (f", `{one.reason}`" if one.reason else "") + (f" ({one.attempts})" if one.attempts > 1 else "")
    safe = "–" if one.safe_s is None else f"{one.safe_s:.1f} s"
    counts = ((one.kept, "kept"), (one.lost, "lost"), (one.missing, "missing"))
    samples = ", ".join(f"{count} {what}" for count, what in counts if count) or "none yet"
    return f"{'**BAD** ' if one.bad else ''}{end}{MARK if one.earlier else ''}<br>{samples}; {safe}"


def _why(one: Ending) -> str:
    return "; ".join([one.unsafe, *one.defects, "still active" if one.active else ""]).strip("; ").replace("\n", " ")
