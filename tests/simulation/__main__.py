"""`make simulate`: thousands of simulated disasters; a failing seed prints the command that repeats it."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence

from tests.simulation.bugs import BUGS
from tests.simulation.every_call import RESTARTS_S
from tests.simulation.history import Ending
from tests.simulation.kinds import KINDS, play, spread
from tests.simulation.page import MIN_SEEDS, PAGE, page
from tests.simulation.pool import begin, every_call, run
from tests.simulation.report import aligned, table, tell, words


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=2000, metavar="N", help="histories (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, metavar="K", help="the first seed (default: %(default)s)")
    parser.add_argument("--kinds", type=_kinds, default=list(KINDS), metavar="A,B", help=", ".join(KINDS))
    parser.add_argument("--seed", type=int, metavar="K", help="this history alone, with its log; with --kind")
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--bug", choices=BUGS, help="with this bug put in, which is to be found")
    parser.add_argument("--every-call", action="store_true", help="one job, killed at each of its calls of the bus")
    parser.add_argument("--write", action="store_true", help=f"writes {PAGE}; at least {MIN_SEEDS} seeds, all kinds")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N")
    asked = parser.parse_args(argv)
    begin()
    if asked.bug:
        BUGS[asked.bug](setattr)
    if asked.seed is not None:
        if asked.kind is None:
            parser.error("--seed needs --kind")
        return _one(asked.kind, asked.seed)
    if asked.write and (asked.seeds < MIN_SEEDS or asked.first or len(asked.kinds) < len(KINDS)):
        parser.error(f"--write needs at least {MIN_SEEDS} seeds over all kinds")
    began = time.monotonic()
    endings: list[Ending] = []
    if asked.every_call or asked.write:
        for ending in every_call(RESTARTS_S, asked.processes):
            endings.append(ending)
            if ending.bad:
                print(f"{ending.kind}, killed before step {ending.seed}: {words(ending)}", flush=True)
    if not asked.every_call:
        for ending in run(list(spread(asked.first + asked.seeds, asked.kinds))[asked.first :], asked.processes):
            endings.append(ending)
            if ending.bad:
                print(tell(ending), flush=True)
    took_s = time.monotonic() - began
    print(aligned(table(endings)))
    bad = sum(bool(ending.bad) for ending in endings)
    print(f"{len(endings)} histories in {took_s:.0f} s ({len(endings) / took_s:.1f}/s), {bad} bad")
    if asked.write:
        page(endings, asked.seeds, took_s)
    return 1 if bad else 0


def _one(kind: str, seed: int) -> int:
    ending = play(kind, seed, keeps_log=True)
    print("\n".join(ending.log))
    print(f"jobs: {ending.jobs}, {ending.simulated_s:.1f} s simulated")
    for bad in ending.bad:
        print(f"BAD at {bad.at:.4f} s: {bad.text}")
    return 1 if ending.bad else 0


def _kinds(text: str) -> list[str]:
    names = text.split(",")
    for name in names:
        if name not in KINDS:
            raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(KINDS)}")
    return names


if __name__ == "__main__":
    sys.exit(main())
