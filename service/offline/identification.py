"""Formats an identified model, or the refusal, as the JSON object of `loopwright identify`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

from loopwright.service.inputs.model_json import dump_model
from loopwright.service.jsonable import JsonObject, json_object
from loopwright.service.offline.csv_record.record import Record
from loopwright.tuning.identification.identify import Identified
from loopwright.tuning.reasons import Refused

_IN_JSON = {"T": "T_s", "L": "L_s"}


def identified(found: Identified, record: Record) -> JsonObject:
    """Returns the JSON object of an identified model; the quantities and their units are those of `Identified`.

    The parameters have the names of the model as JSON (T_s, L_s), and covariance has a row for each of them.
    """
    return json_object(
        {
            "outcome": "identified",
            "reason": None,
            "detail": None,
            "advice": None,
            "model": dump_model(found.model),
            "parameters": named(found.parameters),
            "standard_errors": named(found.standard_errors),
            "covariance": found.covariance.tolist(),
            "loads": [asdict(each) for each in found.loads],
            "drift": found.drift,
            "fit_pct": found.fit_pct,
            "r2_pct": found.r2_pct,
            "noise_std": found.noise_std,
            "whiteness": found.whiteness,
            "explained": found.explained,
            "record": recorded(record),
            "candidates": [asdict(each) for each in found.candidates],
            "notes": list(found.notes),
        }
    )


def named(values: Mapping[str, float]) -> dict[str, float]:
    """Returns parameters under the names that they have in a model as JSON."""
    return {_IN_JSON.get(name, name): value for name, value in values.items()}


def recorded(record: Record) -> dict[str, object]:
    """Returns what was read from a file as JSON: the samples, and the column, range and unit of each quantity."""
    columns = {"mv": ("u", record.u), "pv": ("y", record.y), "sp": ("sp", record.sp)}
    return {
        "samples": len(record.t),
        "sample_time_s": float(record.t[-1] - record.t[0]) / max(len(record.t) - 1, 1),
        "columns": {
            name: {
                "column": record.names.get(key),
                "unit": record.units.get(key),
                "minimum": float(values.min()),
                "maximum": float(values.max()),
            }
            for name, (key, values) in columns.items()
            if values is not None
        },
        "notes": list(record.notes),
    }


def refused(refusal: Refused, record: Record) -> dict[str, object]:
    """Returns the JSON object of a refusal: the first fields of that of a model, no model, and the record."""
    return {
        "outcome": "refused",
        "reason": refusal.reason.value,
        "detail": refusal.detail,
        "advice": refusal.advice,
        "model": None,
        "record": recorded(record),
    }
