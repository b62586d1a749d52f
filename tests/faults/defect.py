"""Runs a module in a process that has a defect as long as a file is there: each check of a sample raises.

python -m tests.faults.defect FILE MODULE ARGS
"""

from __future__ import annotations

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
    _, own_file, module, *arguments = sys.argv
    install(Path(own_file))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
