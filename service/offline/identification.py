"""A model identified from a record, or the refusal, as the JSON object of `loopwright identify`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from loopwright.service.inputs.model_json import dump_model
from loopwright.service.jsonable import to_jsonable
from loopwright.service.offline.csv_record import Record
from loopwright.tuning.identification.identify import Identified
from loopwright.tuning.reasons import Refused

_IN_JSON = {"T": "T_s", "L": "L_s"}


def identified(found: Identified, record: Record) -> dict[str, Any]:
    """Errors, noise_std and rms in the units of what they are of; fits in percent.

    parameters: of the model by name; covariance: of the same, row by row in their order. loads: t_s, when each entered
    if at the plant's input; seen_s, when PV began to answer; size in MV units.
    """
    answer: dict[str, Any] = to_jsonable(
        {
            "outcome": "identified",
            "reason": None,
            "detail": None,
            "advice": None,
            "model": dump_model(found.model),
            "parameters": _named(found.parameters),
            "standard_errors": _named(found.standard_errors),
            "covariance": found.covariance.tolist(),
            "loads": [asdict(each) for each in found.loads],
            "drift": found.drift,
            "fit_pct": found.fit_pct,
            "r2_pct": found.r2_pct,
            "noise_std": found.noise_std,
            "whiteness": found.whiteness,
            "explained": found.explained,
            "samples": len(record.t),
            "candidates": [asdict(each) for each in found.candidates],
            "notes": list(found.notes),
        }
    )
    return answer


def _named(values: Mapping[str, float]) -> dict[str, float]:
    """Parameters by the names that they have in a model as JSON."""
    return {_IN_JSON.get(name, name): value for name, value in values.items()}


def refused(refusal: Refused) -> dict[str, Any]:
    """The same object's first fields, and no model."""
    return {
        "outcome": "refused",
        "reason": refusal.reason.value,
        "detail": refusal.detail,
        "advice": refusal.advice,
        "model": None,
    }
