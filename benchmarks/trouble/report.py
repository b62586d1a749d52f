"""The table of a procedure on plants in trouble, and what it comes to for each of the two classes of kinds."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.cases import ASKED
from benchmarks.command import check_names
from benchmarks.drawn_runs import Draw, run_all, saved
from benchmarks.trouble.kinds import TROUBLES
from benchmarks.trouble.plants import trouble_plants
from benchmarks.trouble.runs import TroubledRun, measure
from benchmarks.tuning import some

TROUBLE = "trouble"
TOO_FAR = 0.3
HEAD = (
    "| kind | level | acts | proposed | true Ms | over asked + 0.3 | unstable | refused | time, Pu: p50 / max |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def line(case: str, runs: Sequence[TroubledRun]) -> str:
    """One row of the table in Markdown."""
    trouble = TROUBLES[case]
    return f"| {trouble.kind} | {trouble.level} | {columns(trouble.later, runs)}"


def columns(later: bool, runs: Sequence[TroubledRun]) -> str:
    """The figures of a row, from the third column on."""
    acts = "later" if later else "within"
    proposed = [each for each in runs if each.reason is None]
    stable = [each.Ms for each in proposed if each.Ms is not None]
    span = f"{min(stable):.2f} .. {max(stable):.2f}" if stable else "-"
    causes = Counter(each.reason for each in runs if each.reason is not None).most_common()
    passed = [each.passed for each in proposed]
    over = sum(each.over > TOO_FAR for each in proposed)
    return (
        f"{acts} | {len(proposed)}/{len(runs)} | {span} | {over}/{len(proposed)} | {len(proposed) - len(stable)} | "
        f"{', '.join(f'{cause} {count}' for cause, count in causes) or '-'} | "
        f"{f'{np.median(passed):.1f} / {max(passed):.1f}' if passed else '-'} |"
    )


def of_kinds(runs: Sequence[TroubledRun]) -> Iterator[str]:
    """The same table with all levels of a kind in one row, as `docs/trouble.md` has it."""
    yield HEAD.replace("level", "levels", 1)
    for kind, later in dict.fromkeys((each.kind, each.later) for each in TROUBLES.values()):
        of_kind = [each for each in runs if TROUBLES[each.case].kind == kind and TROUBLES[each.case].later == later]
        if of_kind:
            yield f"| {kind} | {len({each.case for each in of_kind})} | {columns(later, of_kind)}"


def summary(runs: Sequence[TroubledRun]) -> Iterator[str]:
    """What the kinds of each class come to."""
    for later, what in ((False, "within the record"), (True, "later than the record")):
        mine = [each for each in runs if TROUBLES[each.case].later == later]
        if not mine:
            continue
        proposed = [each for each in mine if each.reason is None]
        wrong, unstable = (sum(each.over > TOO_FAR for each in proposed), sum(each.Ms is None for each in proposed))
        share = 100.0 * wrong / max(len(proposed), 1)
        yield (
            f"Kinds that act {what}: {len(mine)} runs, {len(proposed)} proposed, Ms over {ASKED:g} + {TOO_FAR:g} in "
            f"{wrong} of the proposals ({share:.1f} %), {unstable} of them unstable."
        )


def table(runs: Sequence[TroubledRun]) -> Iterator[str]:
    yield HEAD
    for case in TROUBLES:
        if of_case := [each for each in runs if each.case == case]:
            yield line(case, of_case)
    yield ""
    yield from of_kinds(runs)
    yield ""
    yield from summary(runs)


def cases_of(names: str) -> list[str]:
    """The cases of these names, separated by ';': all, or those of a kind, or one."""
    found: list[str] = []
    for name in names.split(";"):
        found += [each for each, of in TROUBLES.items() if name in (TROUBLE, of.kind, each)] or [name]
    return found


def is_trouble(names: str) -> bool:
    """Whether all of these names are of trouble."""
    return all(each in TROUBLES for each in cases_of(names))


def runs(given: argparse.Namespace) -> Iterator[TroubledRun]:
    """The runs asked for: those that the file holds, and the others, on so many processes."""
    # a batch that is stopped leaves all cases with fewer seeds
    todo: list[Draw] = [
        (plant, given.method, case, seed)
        for seed in given.seeds
        for case in cases_of(given.cases)
        for plant in some(trouble_plants(), given)
    ]
    return run_all(TroubledRun, measure, todo, given.save, given.processes)


def main(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """parser, given: of `benchmarks.tuning`."""
    check_names(parser, "case", cases_of(given.cases), TROUBLES)
    found = list(saved(TroubledRun, given.of) if given.of else runs(given))
    found = [each for each in found if each.method == given.method]
    if not found:
        parser.exit(2, f"{parser.prog}: no run: {given.of or 'no plants or no seeds'}\n")
    print(*table(found), sep="\n")
    seconds = [each.seconds for each in found]
    print(f"\n{len(found)} runs, {np.median(seconds):.2f} s of processor each (median), {max(seconds):.2f} s (most).")
    for each in found:
        if each.reason is None and each.over > TOO_FAR:
            print(f"{each.case}, {each.plant}, seed {each.seed}: Ms {each.Ms or 'unstable'}")
