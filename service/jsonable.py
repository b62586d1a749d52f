"""Results as JSON knows them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import cast

from pydantic import JsonValue

JsonObject = dict[str, JsonValue]
"""An object as JSON knows it."""
JsonScalar = str | bool | int | float | None


def to_jsonable(value: object) -> JsonValue:
    """Dataclasses and mappings as dict, sequences as list, numpy scalars as numbers; NaN and infinity as null."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_jsonable(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    scalar: JsonScalar = value.item() if hasattr(value, "item") else cast(JsonScalar, value)
    return None if isinstance(scalar, float) and not math.isfinite(scalar) else scalar


def json_object(value: object) -> JsonObject:
    """Returns a mapping or a dataclass as a JSON object."""
    found = to_jsonable(value)
    assert isinstance(found, dict), value
    return found


def number(value: JsonValue) -> float:
    """Returns a number out of JSON. Raises TypeError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return float(value)


def to_json_object(value: object) -> JsonObject | None:
    """The same of a stage's result, which is stored as an object: what is none becomes {"value": ...}."""
    found = to_jsonable(value)
    return found if found is None or isinstance(found, dict) else {"value": found}
