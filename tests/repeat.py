"""Tests many times over beside a load, which is what finds those that count on a fast machine.

    python -m tests.repeat                                          # tests that start a service, 50 times, 4 busy ones
    python -m tests.repeat --times 10 tests/unit/service/server/test_stop.py
    python -m tests.repeat -- -m "not starts_processes" tests/unit

Without arguments for pytest, the first round runs all tests that start processes, and finds out which of them start a
service (`loopwright serve` or `demo`); the further rounds repeat these. Each failure is printed as it happens, by the
name of the test, with its output, and counted at the end; the exit status is 1 then.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from tests.starting import STARTS_A_SERVICE

ALL = ("-m", "starts_processes", "tests/unit")
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"  # it ends with us, whatever ends us
RAN = (0, 1)
"""Exit statuses of pytest when it has run tests: all passed, or not."""


@contextmanager
def busy(count: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """So many processes that do nothing but compute."""
    processes = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


@dataclass(frozen=True)
class Round:
    """What pytest has found. last: its last line.  failed: the output of each test that failed, by its name.
    services: pytest's names of the tests that have started a service."""

    last: str
    failed: dict[str, str]
    services: list[str]


def _read(report: Path, last: str) -> Round:
    """report: pytest's JUnit report."""
    failed, services = {}, []
    for case in ElementTree.parse(report).iter("testcase"):
        wrong = [each.text or each.get("message") or "" for each in case if each.tag in ("failure", "error")]
        if wrong:
            said = [each.text or "" for each in case if each.tag in ("system-out", "system-err")]
            failed[f"{case.get('classname')}::{case.get('name')}"] = "\n".join([*wrong, *said])
        services += [each.get("value", "") for each in case.iter("property") if each.get("name") == STARTS_A_SERVICE]
    return Round(last, failed, services)


def once(arguments: Sequence[str], folder: Path) -> Round:
    report = folder / "report.xml"
    report.unlink(missing_ok=True)
    options = ("-q", "-p", "no:cacheprovider", "-p", "tests.starting", "--tb=short", "-o", "junit_logging=all")
    command = (sys.executable, "-m", "pytest", *options, f"--junitxml={report}", *arguments)
    ran = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    last = next((line for line in reversed(ran.stdout.splitlines()) if line.strip()), "")
    if ran.returncode not in RAN or not report.exists():
        return Round(last, {"pytest itself": f"it ended with status {ran.returncode}\n{ran.stdout}"}, [])
    return _read(report, last)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.repeat", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=50, metavar="N", help="default: %(default)s")
    parser.add_argument("--busy", type=int, default=4, metavar="K", help="busy processes beside; default: %(default)s")
    parser.add_argument("--at-once", type=int, default=1, metavar="N", help="tests at a time; default: %(default)s")
    parser.add_argument("pytest", nargs="*", metavar="ARGUMENT", help=f"of pytest; default: {' '.join(ALL)}")
    asked = parser.parse_args(argv)
    arguments: Sequence[str] = asked.pytest or ALL
    beside = () if asked.at_once == 1 else (f"--numprocesses={asked.at_once}", "--dist=loadfile")
    count: Counter[str] = Counter()
    with busy(asked.busy), tempfile.TemporaryDirectory() as folder:
        for number in range(1, asked.times + 1):
            began = time.monotonic()
            found = once((*beside, *arguments), Path(folder))
            print(f"{number} of {asked.times}, {time.monotonic() - began:.0f} s: {found.last}", flush=True)
            for name, said in found.failed.items():
                print(f"FAILED {name}\n{said}\n", flush=True)
            count.update(found.failed.keys())
            if number == 1 and not asked.pytest and found.services:
                arguments = found.services
                print(f"{len(arguments)} of them start a service and are repeated", flush=True)
    for name, times in count.most_common():
        print(f"{name} failed {times} of {asked.times} times")
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
