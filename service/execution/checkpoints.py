"""The results of the stages that a job's stored events report as finished, from which the procedure continues."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from loopwright.tuning.five_stage.procedure import Finished


def finished(results: Iterable[tuple[str, Mapping[str, object] | None]]) -> Finished:
    """Returns the results of the finished stages.

    results: stage and stored result of each `stage_done` event, in order; the last one of a stage counts.
    A result that is not in the form of this version is left out, so its stage runs again.
    """
    kinds = {field.name: get_type_hints(Finished)[field.name] for field in fields(Finished)}
    by_stage: dict[str, Any] = {}
    for stage, result in results:
        if stage in kinds and result is not None:
            try:
                by_stage[stage] = TypeAdapter(kinds[stage]).validate_python(_numbers(result, kinds[stage]))
            except ValidationError:
                by_stage.pop(stage, None)
    return Finished(**by_stage)


def _numbers(result: Mapping[str, object], kind: Any) -> dict[str, object]:
    """Returns the numbers of a stored result; a null stands for nan, which JSON lacks."""
    hints = get_type_hints(kind.__args__[0])
    return {name: math.nan if value is None and hints.get(name) is float else value for name, value in result.items()}
