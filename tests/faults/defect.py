"""Runs a module in a process that has a defect as long as a file is there: each check of a sample raises.

python -m tests.faults.defect FILE MODULE ARGS
"""

from __future__ import annotations

import argparse
import runpy
import sys
from pathlib import Path

from loopwright.service.execution.guard import Guard
from loopwright.tuning.plan import Sample


def install(file: Path) -> None:
    real = Guard.check

    def check(self: Guard, sample: Sample) -> None:
        if file.exists():
            raise ZeroDivisionError("a defect made on purpose")
        real(self, sample)

    Guard.check = check  # type: ignore[method-assign]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.faults.defect", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help="the defect is there as long as this file is")
    parser.add_argument("module", metavar="MODULE")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="ARGS")
    asked = parser.parse_args()
    install(asked.file)
    sys.argv = [asked.module, *asked.arguments]
    runpy.run_module(asked.module, run_name="__main__", alter_sys=True)
