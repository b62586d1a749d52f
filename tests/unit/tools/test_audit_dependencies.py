from __future__ import annotations

import json
import runpy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

TOOL = runpy.run_path(str(Path(__file__).parents[3] / "tools" / "audit_dependencies.py"))

GOOD = {"name": "good", "version": "1", "vulns": []}
BAD = {"name": "bad", "version": "2", "vulns": [{"id": "PYSEC-1"}, {"id": "PYSEC-2"}]}
UNKNOWN = {"name": "own", "skip_reason": "not found"}
RECOGNISED = [{"name": "jinja2", "version": "2.4.1", "vulns": [{"id": "PYSEC-0"}]}]


def verdict(
    consistent: bool = True, known_bad: Any = RECOGNISED, found: Any = (GOOD,), required: bool = False
) -> tuple[int, str]:
    def run(module: Sequence[str]) -> tuple[int, str]:
        if module[0] == "pip":
            return (0, "No broken requirements found.") if consistent else (1, "a 1 has requirement b<2")
        answer = known_bad if "--requirement" in module else found
        return 0, answer if isinstance(answer, str) else json.dumps({"dependencies": list(answer), "fixes": []})

    answer: tuple[int, str] = TOOL["audit"](run, required)
    return answer


@pytest.mark.parametrize(
    ("given", "status", "words"),
    [
        ({}, 0, "1 packages audited for known vulnerabilities, none found"),
        ({"found": (GOOD, UNKNOWN)}, 0, "1 packages audited for known vulnerabilities, 1 not known to the source: own"),
        ({"found": (GOOD, BAD)}, 1, "bad 2: PYSEC-1, PYSEC-2"),
        ({"consistent": False}, 1, "b<2"),
        ({"found": ""}, 0, "NOT audited"),
        # no network; and a mirror that answers, but knows of no vulnerabilities
        ({"known_bad": ""}, 0, "NOT audited"),
        ({"known_bad": [UNKNOWN]}, 0, "NOT audited"),
        ({"known_bad": [GOOD]}, 0, "NOT audited"),
        ({"known_bad": "", "required": True}, 1, "NOT audited"),
        ({"found": "", "required": True}, 1, "NOT audited"),
    ],
)
def test_what_is_said_is_what_was_done(given: dict[str, Any], status: int, words: str) -> None:
    found = verdict(**given)
    assert found[0] == status and words in found[1]
    assert found[1].startswith("dependencies: ")
    assert ("consistent (pip check)" in found[1]) == given.get("consistent", True)
