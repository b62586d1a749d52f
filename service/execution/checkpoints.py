"""What a job's stored events say was finished, as the results the procedure goes on from."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from loopwright.tuning.five_stage.procedure import Finished


def finished(results: Iterable[tuple[str, Mapping[str, Any] | None]]) -> Finished:
    """results: of each `stage_done` event the stage and its stored result, in their order; the last of a stage counts.

    A result that is not of this version's form is left out: its stage runs again.
    """
    kinds = {field.name: get_type_hints(Finished)[field.name] for field in fields(Finished)}
    found: dict[str, Any] = {}
    for stage, result in results:
        if stage in kinds and result is not None:
            try:
                found[stage] = TypeAdapter(kinds[stage]).validate_python(_numbers(result, kinds[stage]))
            except ValidationError:
                found.pop(stage, None)
    return Finished(**found)


def _numbers(result: Mapping[str, Any], kind: Any) -> dict[str, Any]:
    """JSON has no nan: a number that was none comes back as null."""
    hints = get_type_hints(kind.__args__[0])
    return {name: math.nan if value is None and hints.get(name) is float else value for name, value in result.items()}
