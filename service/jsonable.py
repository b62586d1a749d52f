"""Results as JSON knows them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any


def to_jsonable(value: object) -> Any:
    """Dataclasses and mappings as dict, sequences as list, numpy scalars as numbers; NaN and infinity as null."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_jsonable(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json_object(value: object) -> dict[str, Any] | None:
    """The same of a stage's result, which is stored as an object: what is none becomes {"value": ...}."""
    found = to_jsonable(value)
    return found if found is None or isinstance(found, dict) else {"value": found}
