"""The loops that disturb each other: those of one area, and a loop whose set-point another one moves. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from loopwright.service.inputs.config import LoopConfig


def disturbers(loop: LoopConfig, others: Iterable[LoopConfig]) -> list[str]:
    """The tags of the loops whose tests disturb this one: those of its area, and those that it moves the set-point
    of as their `outer_loop`."""
    return sorted(
        other.tag
        for other in others
        if other.tag != loop.tag and (_same_area(loop, other) or other.outer_loop == loop.tag)
    )


def _same_area(loop: LoopConfig, other: LoopConfig) -> bool:
    return loop.area is not None and loop.area == other.area
