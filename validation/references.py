"""The printed numbers and what independent calculations gave, as data."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "tests/data"


@dataclass(frozen=True, slots=True)
class References:
    """five_stage, rules, search, loops: the tables of the tests.  more: printed numbers that no test of a part needs.

    plants: the 50 models of the five-stage paper.
    """

    five_stage: dict[str, Any]
    rules: dict[str, Any]
    search: dict[str, Any]
    loops: dict[str, Any]
    more: dict[str, Any]
    plants: list[dict[str, Any]]


def load() -> References:
    def read(path: Path) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found

    return References(
        five_stage=read(DATA / "five-stage-tables.json"),
        rules=read(DATA / "tuning-rules-tables.json"),
        search=read(DATA / "s-plane-me-pso-tables.json"),
        loops=read(DATA / "loops-recomputed.json"),
        more=read(DATA / "validation-tables.json"),
        plants=read(ROOT / "plantsim/models-50.json")["models"],
    )
