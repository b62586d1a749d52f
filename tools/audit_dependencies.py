"""Are the installed packages consistent, and is one of them known to be vulnerable? Part of `make check`.

The first is always checked (pip check). The second needs a source that knows: whether it does is tried first, on a
release that is known to be vulnerable. A source that finds nothing there proves nothing about the rest: then it is said
that no audit was done. That is an error only with LOOPWRIGHT_REQUIRE_AUDIT=1, so that work goes on without a network.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

KNOWN_BAD = "jinja2==2.4.1"
AUDIT = ("pip_audit", "--progress-spinner", "off", "--format", "json", "--desc", "off", "--timeout", "5")
PATIENCE_S = 300

Run = Callable[[Sequence[str]], tuple[int, str]]


def run(module: Sequence[str]) -> tuple[int, str]:
    """Status and standard output of python -m MODULE ..."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", *module], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            timeout=PATIENCE_S,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return 1, ""
    return done.returncode, done.stdout


def audit(run: Run, required: bool) -> tuple[int, str]:
    """Exit status and what to say."""
    status, text = run(["pip", "check"])
    if status:
        return 1, f"dependencies: not consistent\n{text.strip()}"
    said = "dependencies: consistent (pip check)"
    with tempfile.TemporaryDirectory() as folder:
        bad = Path(folder) / "known-bad.txt"
        bad.write_text(KNOWN_BAD + "\n", encoding="utf-8")
        tried = _report(run([*AUDIT, "--disable-pip", "--no-deps", "--requirement", str(bad)])[1])
    if not any(found["vulns"] for found in tried):
        why = f"no source of known vulnerabilities answers here ({KNOWN_BAD} was not recognised)"
        return int(required), f"{said}; NOT audited for vulnerabilities: {why}"
    found = _report(run([*AUDIT, "--skip-editable"])[1])
    if not found:
        return int(required), f"{said}; NOT audited for vulnerabilities: the audit broke off"
    unknown = [x["name"] for x in found if "skip_reason" in x]
    said += f"; {len(found) - len(unknown)} packages audited for known vulnerabilities"
    if unknown:
        said += f", {len(unknown)} not known to the source: {', '.join(unknown)}"
    bad_ones = [f"  {x['name']} {x['version']}: {', '.join(v['id'] for v in x['vulns'])}" for x in found if x["vulns"]]
    return int(bool(bad_ones)), "\n".join([said + (", vulnerable:" if bad_ones else ", none found"), *bad_ones])


def _report(text: str) -> list[dict[str, Any]]:
    """pip-audit's entries; none when it ended otherwise than with a report."""
    try:
        return [{"vulns": [], **entry} for entry in json.loads(text)["dependencies"]]
    except (ValueError, KeyError, TypeError):
        return []


if __name__ == "__main__":
    exit_status, verdict = audit(run, bool(os.environ.get("LOOPWRIGHT_REQUIRE_AUDIT")))
    print(verdict)
    sys.exit(exit_status)
