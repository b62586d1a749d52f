"""The paper's tables as data: what was printed, how damaged print is read, what an independent calculation gave."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, TransferFunction

ROOT = Path(__file__).resolve().parents[3]

TABLES: dict[str, Any] = json.loads((ROOT / "tests/data/five-stage-tables.json").read_text(encoding="utf-8"))
GOLDEN: dict[str, Any] = TABLES["golden"]
MODELS: list[dict[str, Any]] = json.loads((ROOT / "plantsim/models-50.json").read_text(encoding="utf-8"))["models"]

EQUIPOLE5 = TransferFunction((1.0,), (1.0, 5.0, 10.0, 10.0, 5.0, 1.0))
"""1/(s+1)^5, the plant of Tables 1 and 2."""


def table4_model(name: str) -> FOPDT:
    row = next(m for m in TABLES["table4"]["models_settled"] if m["id"] == name)
    return FOPDT(row["k"], row["T"], row["tau"])


def transfer_function(entry: dict[str, Any]) -> TransferFunction:
    return TransferFunction(tuple(entry["num"]), tuple(entry["den"]), entry["delay"])


def ziegler_nichols(Ku: float, Pu: float) -> Gains:
    return Gains(Kp=Ku / 2.2, Ti=Pu / 1.2)
