"""`make hostile`: everything hostile at once beside live tests and loops in operation; prints one table.

It fails when an abort waits, supervision is late, memory grows, a loop is not as it was, or a test was ended by it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median

from tests.hostile.measuring import EXPECTED_ENDS, Found, Measuring
from tests.hostile.site import Site

ABORT_P99_S, EFFECT_S, LATE_S = 0.5, 1.0, 0.05
GROWTH = 1.3
"""Memory at the end, of what it was when everything had begun."""
MAX_MB = 600.0
MEMORY_EVERY_S = 5.0


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.hostile", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--loops", type=int, default=100, help="in operation (default: %(default)s)")
    parser.add_argument("--tests", type=int, default=10, help="under test at the same time (default: %(default)s)")
    asked = parser.parse_args(argv)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        site = Site(stack, folder, asked.loops)
        with Measuring(site, asked.tests) as measuring:
            measuring.count()
            attacks = [
                site.attackers("reads_of_a_silent_node=60", "reads_of_the_database=4", key=site.stranger),
                site.attackers("unfinished_bodies=64", "costly_tunings=2", "costly_rehearsals=2", key=site.stranger),
                site.attackers("guesses_at_a_key=200", key=site.guessed),
                site.attackers("idle_connections=1100", "slow_heads=50", "answers_not_taken=20"),
            ]
            began = processors()
            over = time.monotonic() + 60.0 * asked.minutes
            while time.monotonic() < over:
                measuring.note_memory()
                time.sleep(min(MEMORY_EVERY_S, max(0.0, over - time.monotonic())))
            measuring.note_memory()
        for attack in attacks:
            attack.stop()
        measuring.end_tests()
        rows = judged(measuring.found, site.unsafe())
        rows.append(("event loop held up by at most", f"{1e3 * site.event_loop_late_s():.0f} ms", "", True))
        for log in sorted(folder.glob("attackers-*.log")):
            print(f"answered: {log.read_text().splitlines()[-1]}")
    print("\n| what | found | permitted | |\n| --- | --- | --- | --- |")
    rows.append(("processors of the machine: busy, and taken by its host", machine_since(began), "", True))
    for what, found, permitted, good in rows:
        print(f"| {what} | {found} | {permitted} | {'good' if good else 'BAD'} |")
    return 0 if all(row[-1] for row in rows) else 1


def judged(found: Found, unsafe: dict[str, str]) -> list[tuple[str, str, str, bool]]:
    abort, late, memory = p99(found.abort_s), max(found.late_s, default=float("inf")), found.memory_MB
    growth = memory[-1] / memory[len(memory) // 5]
    course = ", ".join(f"{memory[len(memory) * tenth // 10]:.0f}" for tenth in range(10))
    ended = {end: number for end, number in found.ends.items() if end not in EXPECTED_ENDS}
    return [
        (f"{len(found.abort_s)} aborts answered, p99", f"{abort:.3f} s", f"{ABORT_P99_S} s", abort < ABORT_P99_S),
        ("the same, median", f"{median(found.abort_s or [float('inf')]):.3f} s", "", True),
        (
            "aborts, until the controller had ended the test, p99",
            f"{p99(found.effect_s):.3f} s",
            f"{EFFECT_S} s",
            p99(found.effect_s) < EFFECT_S,
        ),
        ("the same, at most", f"{max(found.effect_s, default=float('inf')):.3f} s", "", True),
        ("aborts, until the loop was read back as home, p99", f"{p99(found.home_s):.3f} s", "", True),
        ("/healthz, p99", f"{p99(found.healthz_s):.3f} s", f"{ABORT_P99_S} s", p99(found.healthz_s) < ABORT_P99_S),
        ("supervision late by at most", f"{1e3 * late:.0f} ms", f"{1e3 * LATE_S:.0f} ms", late <= LATE_S),
        ("the same, p99", f"{1e3 * p99(found.late_s):.0f} ms", "", True),
        (
            f"the same, of the {len(found.late_alone_s)} of {len(found.late_s)} while the machine was not late",
            f"{1e3 * max(found.late_alone_s, default=0.0):.0f} ms",
            "",
            True,
        ),
        ("a process that only sleeps is woken late, p99", f"{1e3 * p99(found.machine_late_s):.0f} ms", "", True),
        ("the same, at most", f"{1e3 * max(found.machine_late_s, default=0.0):.0f} ms", "", True),
        ("memory at most", f"{max(memory):.0f} MB", f"{MAX_MB:.0f} MB", max(memory) <= MAX_MB),
        ("memory, end to beginning", f"{growth:.2f}", f"{GROWTH}", growth <= GROWTH),
        ("memory at each tenth of the time", f"{course} MB", "", True),
        ("loops not as they were", str(unsafe or 0), "0", not unsafe),
        ("tests that came to their end", str(sum(found.ends.values())), "", True),
        ("tests that ended otherwise", str(ended or 0), "0", not ended),
        ("requests of the operator told to come again, aborts never", str(found.refused), "", True),
    ]


def processors() -> list[int]:
    """Time of all processors, in ticks: user, nice, system, idle, waiting, interrupts (two), taken by the host."""
    return [int(ticks) for ticks in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]


def machine_since(began: list[int]) -> str:
    spent = [now - then for now, then in zip(processors(), began, strict=True)]
    idle, taken = spent[3] + spent[4], spent[7]
    return f"{1 - (idle + taken) / sum(spent):.0%}, {taken / sum(spent):.0%}"


def p99(times: list[float]) -> float:
    return sorted(times)[int(0.99 * len(times))] if times else float("inf")


if __name__ == "__main__":
    sys.exit(main())
