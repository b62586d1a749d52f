"""Plants in trouble retuned by the real processes over a CAN bus: 12 plants, six kinds of trouble, and none of them.

    tools/with-vcan --timeout 3600 -- .venv/bin/python -m benchmarks.trouble_on_bus --save FILE
    .venv/bin/python -m benchmarks.trouble_on_bus --rehearse --save FILE     # the same cases without a bus
    .venv/bin/python -m benchmarks.trouble_on_bus --of FILE                  # the table of both, nothing is run

Plant simulator, controller and service are processes as a user starts them. Each plant has a bus, a plant node and a
controller node of its own, with a channel for each kind of trouble; one service retunes the loops of --together plants
at once by the relay procedure. A proposal is judged as that of a rehearsal is: on the worst linearisation of the plant
at the operating points that the recorded MV took it to (docs/trouble.md).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from benchmarks.cases import ASKED
from benchmarks.command import CANNOT, Missing, check_names
from benchmarks.drawn_runs import Draw, kept, run_all, saved
from benchmarks.plants import Plant
from benchmarks.trouble.bus_cases import BUS_CASES, BusCase, bus_plants
from benchmarks.trouble.bus_runs import CUT_OFF, ON_BUS, bus_run
from benchmarks.trouble.bus_site import TroubleSite, interfaces
from benchmarks.trouble.report import HEAD, TOO_FAR, line
from benchmarks.trouble.runs import TroubledRun, measure
from benchmarks.tuning import runs_parser, some
from loopwright.tuning.fast.relay.procedure import FAST

REPEATS = 2
WAYS = {ON_BUS: "bus", FAST: "rehearsal"}


Todo = dict[tuple[int, Plant], list[BusCase]]
"""By seed and plant, the cases to be run."""


def on_bus(todo: Todo, together: int, sample_wall_s: float) -> Iterator[TroubledRun]:
    """The runs through the bus, so many plants of a seed at once. Raises Missing, RuntimeError."""
    for seed in sorted({seed for seed, _ in todo}):
        mine = [(plant, cases) for (of, plant), cases in todo.items() if of == seed]
        for first in range(0, len(mine), together):
            batch = mine[first : first + together]
            began = time.monotonic()
            # in memory: under user-mode Linux every write to a disk would hold the whole guest up
            with ExitStack() as stack:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir="/dev/shm")))
                site = TroubleSite(stack, folder, interfaces(len(batch)), batch, seed, sample_wall_s)
                up = time.monotonic() - began
                yield from (bus_run(*each) for each in site.retuned())
            took = time.monotonic() - began
            names = "; ".join(plant.name for plant, _ in batch)
            print(f"  {names}: {took:.0f} s, {up:.0f} s of it to start", file=sys.stderr, flush=True)


def runs(draws: Sequence[Draw], given: argparse.Namespace) -> Iterator[TroubledRun]:
    """Those that the file has, then the others as they end, each added to the file.

    One that the machine has cut off (it stood still for longer than a lease or a heartbeat) says nothing of the
    procedure: it is not kept, and is run once more.
    """
    known = {each.draw: each for each in saved(TroubledRun, given.save)}
    left = {(plant.name, method, case, seed): (plant, method, case, seed) for plant, method, case, seed in draws}
    yield from (known[draw] for draw in left if draw in known)
    left = {draw: each for draw, each in left.items() if draw not in known}
    for _ in range(1 + REPEATS):
        todo: Todo = {}
        for plant, _, case, seed in left.values():
            todo.setdefault((seed, plant), []).append(BUS_CASES[case])
        for each in on_bus(todo, given.together, given.sample_wall_s):
            if each.reason in CUT_OFF:
                print(f"  cut off: {each.case}, {each.plant}: {each.detail}", file=sys.stderr, flush=True)
            else:
                del left[each.draw]
                yield kept(each, given.save)
    for plant, _, case, seed in left.values():
        print(f"  not known, cut off by the machine: {case}, {plant.name}, seed {seed}", file=sys.stderr, flush=True)


def table(runs: Sequence[TroubledRun]) -> Iterator[str]:
    """For each case the row of the bus and that of the rehearsals."""
    head, rule = HEAD.split("\n")
    yield f"| through {head}\n| --- {rule}"
    for case in BUS_CASES:
        for method, way in WAYS.items():
            if mine := [each for each in runs if (each.case, each.method) == (case, method)]:
                yield f"| {way} {line(case, mine)}"
    yield ""
    for method, way in WAYS.items():
        proposed = [each for each in runs if each.method == method and each.reason is None]
        if mine := [each for each in runs if each.method == method]:
            wrong, unstable = sum(each.over > TOO_FAR for each in proposed), sum(each.Ms is None for each in proposed)
            yield (
                f"- {way}: {len(mine)} runs, {len(proposed)} proposed, Ms over {ASKED:g} + {TOO_FAR:g} in {wrong} of "
                f"the proposals, {unstable} of them unstable."
            )


def main() -> None:
    parser = runs_parser(__doc__)
    names = "; ".join(BUS_CASES).replace("%", "%%")
    parser.add_argument("--cases", help=f"names, separated by ';'; by default all: {names}")
    parser.add_argument("--together", type=int, default=2, metavar="N", help="so many plants at once, each on a bus")
    parser.add_argument(
        "--sample-wall-s", type=float, default=0.1, metavar="S", help="wall time of a sample of every plant"
    )
    parser.add_argument("--rehearse", action="store_true", help="the same cases in rehearsals, without a bus")
    parser.add_argument("--processes", type=int, default=1, metavar="N", help="for rehearsals")
    given = parser.parse_args()
    cases = given.cases.split(";") if given.cases else list(BUS_CASES)
    check_names(parser, "case", cases, BUS_CASES)
    plants = some(bus_plants(), given)
    began = time.monotonic()
    if given.of:
        found = saved(TroubledRun, given.of)
    elif given.rehearse:
        draws = [(plant, FAST, case, seed) for seed in given.seeds for plant in plants for case in cases]
        found = list(run_all(TroubledRun, measure, draws, given.save, given.processes))
    else:
        draws = [(plant, ON_BUS, case, seed) for seed in given.seeds for plant in plants for case in cases]
        try:
            found = list(runs(draws, given))
        except Missing as missing:
            parser.exit(CANNOT, f"{parser.prog}: {missing}\n")
    if not found:
        parser.exit(2, f"{parser.prog}: no run: {given.of or 'no plants or no seeds'}\n")
    print(*table(found), sep="\n")
    if not given.of:
        print(f"\n{len(found)} runs in {time.monotonic() - began:.0f} s.")
    for each in found:
        if each.reason is None and each.over > TOO_FAR:
            print(f"{WAYS[each.method]}: {each.case}, {each.plant}, seed {each.seed}: Ms {each.Ms or 'unstable'}")


if __name__ == "__main__":
    main()
