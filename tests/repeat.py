"""Tests many times over beside a load, which is what finds those that count on a fast machine.

    python -m tests.repeat                                          # tests that start processes, 50 times, 4 busy ones
    python -m tests.repeat --times 10 tests/unit/service/server/test_stop.py
    python -m tests.repeat -- -m "not starts_processes" tests/unit

What failed is told by name as it fails, with its output, and counted at the end; the exit status is 1 then.
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
from pathlib import Path
from xml.etree import ElementTree

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


def failures(report: Path) -> dict[str, str]:
    """By test, with what it said; from pytest's JUnit report."""
    found = {}
    for case in ElementTree.parse(report).iter("testcase"):
        wrong = [each.text or each.get("message") or "" for each in case if each.tag in ("failure", "error")]
        if wrong:
            said = [each.text or "" for each in case if each.tag in ("system-out", "system-err")]
            found[f"{case.get('classname')}::{case.get('name')}"] = "\n".join([*wrong, *said])
    return found


def once(arguments: Sequence[str], folder: Path) -> tuple[str, dict[str, str]]:
    """pytest's last line, and what failed."""
    report = folder / "report.xml"
    report.unlink(missing_ok=True)
    told = ("-q", "-p", "no:cacheprovider", "--tb=short", "-o", "junit_logging=all", f"--junitxml={report}")
    ran = subprocess.run([sys.executable, "-m", "pytest", *told, *arguments], stdout=subprocess.PIPE, text=True)
    last = next((line for line in reversed(ran.stdout.splitlines()) if line.strip()), "")
    if ran.returncode not in RAN or not report.exists():
        return last, {"pytest itself": f"it ended with status {ran.returncode}\n{ran.stdout}"}
    return last, failures(report)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.repeat", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=50, metavar="N", help="default: %(default)s")
    parser.add_argument("--busy", type=int, default=4, metavar="K", help="busy processes beside; default: %(default)s")
    parser.add_argument("pytest", nargs="*", metavar="ARGUMENT", help=f"of pytest; default: {' '.join(ALL)}")
    asked = parser.parse_args(argv)
    count: Counter[str] = Counter()
    with busy(asked.busy), tempfile.TemporaryDirectory() as folder:
        for number in range(1, asked.times + 1):
            began = time.monotonic()
            last, failed = once(asked.pytest or ALL, Path(folder))
            print(f"{number} of {asked.times}, {time.monotonic() - began:.0f} s: {last}", flush=True)
            for name, said in failed.items():
                print(f"FAILED {name}\n{said}\n", flush=True)
            count.update(failed.keys())
    for name, times in count.most_common():
        print(f"{name} failed {times} of {asked.times} times")
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
