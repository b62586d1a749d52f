"""`make bench`: every benchmark in a process of its own, then one table in Markdown.

    python -m benchmarks
    python -m benchmarks answers engine     # only the figures of these, as JSON
    python -m benchmarks preview            # an hour: only where it is asked for

A benchmark that lacks something on this machine has a row that says what; the others run. The exit status is 1 when one
of them went wrong, or one that was asked for by name could not be measured.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

from benchmarks.command import CANNOT, check_names, parser_of
from benchmarks.table import HEAD, ROWS, row

WITH_VCAN = ("tools/with-vcan", "--again", "--timeout", "900", "--")
APART = ("preview",)
"""Those that take an hour: they are run by name only."""
NO_VCAN = "no CAN interface vcan0 is to be had, tools/with-vcan says above what to install"


@dataclass(frozen=True)
class Benchmark:
    """command: what runs it. lacks: what to install where it ends with the status CANNOT."""

    command: Sequence[str]
    lacks: str = ""


def _on_a_bus(name: str) -> Benchmark:
    return Benchmark((*WITH_VCAN, sys.executable, "-m", f"benchmarks.{name}"), NO_VCAN)


BENCHMARKS = {name: Benchmark((sys.executable, "-m", f"benchmarks.{name}")) for name in ROWS} | {
    "bus": _on_a_bus("bus"),
    "load": _on_a_bus("load"),
    "gateways": Benchmark(
        (sys.executable, "-m", "benchmarks.gateways"),
        "no PostgreSQL server is to be had: sudo apt-get install postgresql",
    ),
    "page": Benchmark(
        (sys.executable, "-m", "benchmarks.page"),
        "no browser is to be had: sudo apt-get install chromium",
    ),
}


@dataclass(frozen=True)
class NotMeasured:
    why: str
    wrong: bool


def figures(benchmark: Benchmark) -> dict[str, Any] | NotMeasured:
    """The JSON object that a benchmark prints; under user-mode Linux its progress comes before it."""
    found = subprocess.run(benchmark.command, stdout=subprocess.PIPE, text=True)
    printed = "\n" + found.stdout.replace("\r", "")
    if found.returncode == CANNOT and benchmark.lacks:
        return NotMeasured(benchmark.lacks, wrong=False)
    if found.returncode:
        print(found.stdout, file=sys.stderr)
        return NotMeasured(f"it ended with status {found.returncode}, see what it said above", wrong=True)
    try:
        answer: dict[str, Any] = json.JSONDecoder().raw_decode(printed[printed.rindex("\n{") + 1 :])[0]
    except ValueError:
        print(found.stdout, file=sys.stderr)
        return NotMeasured("it ended without figures, see what it said above", wrong=True)
    return answer


def main(argv: Sequence[str] | None = None, benchmarks: dict[str, Benchmark] = BENCHMARKS) -> int:
    parser = parser_of(__doc__)
    parser.add_argument(
        "names", metavar="NAME", nargs="*", help=f"any of {', '.join(benchmarks)}; default: all but {', '.join(APART)}"
    )
    names = parser.parse_args(argv).names
    check_names(parser, "benchmark", names, benchmarks)
    loads = [os.getloadavg()[0]]
    found: dict[str, dict[str, Any]] = {}
    without: dict[str, NotMeasured] = {}
    asked = names or [name for name in benchmarks if name not in APART]
    for name in asked:
        print(f"{name} ...", file=sys.stderr, flush=True)
        answer = figures(benchmarks[name])
        if isinstance(answer, NotMeasured):
            without[name] = answer
            print(f"{name}: not measured: {answer.why}", file=sys.stderr, flush=True)
        else:
            found[name] = answer
        loads.append(os.getloadavg()[0])
    if names:
        print(json.dumps(found, indent=1))
        return 1 if without else 0
    vcan = f"vcan by with-vcan ({found['bus']['vcan']}), " if "bus" in found else ""
    print(
        f"{date.today()}, Python {platform.python_version()}, {platform.machine()}, {os.cpu_count()} processors, {vcan}"
        f"load average before and after each part: {', '.join(f'{load:.1f}' for load in loads)}\n"
    )
    lines = list(HEAD)
    for name in asked:
        lines += [row(name, f"not measured: {without[name].why}")] if name in without else ROWS[name](found[name])
    print("\n".join(lines))
    print("\n" + json.dumps(found, indent=1), file=sys.stderr)
    return 1 if any(each.wrong for each in without.values()) else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
