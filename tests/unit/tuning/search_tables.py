"""The tables of the pole-placement and the ME-PSO paper as data, and the plants in them."""

from __future__ import annotations

import json
from typing import Any

from loopwright.tuning.models import TransferFunction
from tests.unit.tuning.tables import ROOT

TABLES: dict[str, Any] = json.loads((ROOT / "tests/data/s-plane-me-pso-tables.json").read_text(encoding="utf-8"))
S_PLANE: dict[str, Any] = TABLES["paper_a"]
ME_PSO: dict[str, Any] = TABLES["paper_b"]

OBJECTS = {
    name: TransferFunction(tuple(entry["num"]), tuple(entry["den"])) for name, entry in S_PLANE["objects"].items()
}
PLANTS = {
    name: TransferFunction(tuple(entry["num"]), tuple(entry["den"]), entry["dead_time"])
    for name, entry in ME_PSO["plants"].items()
}
HORIZON_S = {"G1": 60.0, "G2": 60.0, "G3": 60.0, "G4": 20.0, "G5": 80.0}
