"""`make faults`: every fault in every stage, on live processes; writes docs/faults.md. Fails on an unsafe ending."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from datetime import UTC, datetime

from tests.e2e.plantsite import STAGES
from tests.faults import campaign, report
from tests.faults.cases import BOTH
from tests.faults.ending import Ending
from tests.faults.watch_cases import ALL_FAULTS
from tests.faults.watch_ending import MOMENTS


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    stages = [*STAGES, *MOMENTS]
    parser.add_argument("--faults", type=_some(list(ALL_FAULTS)), default=list(ALL_FAULTS), metavar="A,B")
    parser.add_argument("--stages", type=_some(stages), default=stages, metavar="X,Y", help="and moments of the watch")
    parser.add_argument("--database", choices=BOTH, help="default: both, for the rows that are tried on both")
    parser.add_argument("--at-once", type=int, default=3, metavar="N", help="rows side by side (default: %(default)s)")
    asked = parser.parse_args(argv)
    databases = [asked.database] if asked.database else BOTH
    began = datetime.now(UTC)
    found: list[Ending] = []
    for row in campaign.run(asked.faults, asked.stages, databases, asked.at_once):
        found += row
        report.write(campaign.merge(row, f"{began:%Y-%m-%d}"))  # what is found is kept, whatever comes
    bad = [one for one in found if one.bad]
    took_min = (datetime.now(UTC) - began).total_seconds() / 60.0
    print(f"{len(found)} runs in {took_min:.0f} min, {len(bad)} bad; the table is {report.TABLE}")
    return 1 if bad else 0


def _some(known: Sequence[str]) -> object:
    def chosen(text: str) -> list[str]:
        names = text.split(",")
        for name in names:
            if name not in known:
                raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(known)}")
        return names

    return chosen


if __name__ == "__main__":
    sys.exit(main())
