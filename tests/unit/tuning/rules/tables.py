"""Printed and recomputed settings of three papers, as data."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from loopwright.tuning.models import FOPDT, SOPDT, TransferFunction
from tests.unit.tuning.tables import ROOT

TABLES: dict[str, Any] = json.loads((ROOT / "tests/data/tuning-rules-tables.json").read_text(encoding="utf-8"))
OBJECTS: dict[str, dict[str, float]] = TABLES["direct_synthesis"]["objects"]
PLANTS: dict[str, dict[str, Any]] = TABLES["me_pso"]["plants"]


def sopdt(name: str) -> SOPDT:
    """An object of the direct-synthesis paper."""
    o = OBJECTS[name]
    return SOPDT(K=o["K"], T1=o["T1"], T2=o["T2"], L=o["L"])


def plant(name: str) -> TransferFunction:
    """A plant of the ME-PSO paper."""
    den, num = np.array([1.0]), np.array([1.0])
    for lag in PLANTS[name]["lags"]:
        den = np.polymul(den, [lag, 1.0])
    for zero in PLANTS[name]["zeros"]:
        num = np.polymul(num, [zero, 1.0])
    return TransferFunction(tuple(num), tuple(den), PLANTS[name]["L"])


def moments(name: str) -> FOPDT:
    """Its FOPDT by moments, on which that paper's rules were evaluated: T^2 is the variance, L + T the mean."""
    p = PLANTS[name]
    mean = sum(p["lags"]) - sum(p["zeros"]) + p["L"]
    T = (sum(x * x for x in p["lags"]) - sum(x * x for x in p["zeros"])) ** 0.5
    return FOPDT(1.0, T, mean - T)
