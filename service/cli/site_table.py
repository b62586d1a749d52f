"""The loops that a service is configured for, as it starts."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.protocol.profile import node_name
from loopwright.service.cli.terminal import console, rows
from loopwright.service.inputs.config import LoopConfig

MAX_LOOPS = 40
"""Largest number of loops that are shown."""


def where(config: LoopConfig) -> str:
    """Returns the bus, the node and the channel of a loop's controller."""
    return f"{config.bus} node {node_name(config.controller_node)} channel {config.channel}"


def show(loops: Sequence[LoopConfig]) -> None:
    """Shows where each loop is, its limits and its T95."""
    rows(
        f"{len(loops)} {'loop' if len(loops) == 1 else 'loops'}",
        ("tag", "where", "PV", "unit", "MV %", "T95 s", "area"),
        (
            (
                each.tag, where(each), f"{each.pv_limits.low:g}..{each.pv_limits.high:g}", each.pv_unit,
                f"{each.mv_limits.low:g}..{each.mv_limits.high:g}", each.t95_s, each.area or "",
            )
            for each in loops[:MAX_LOOPS]
        ),
        never_cut=("tag", "PV", "MV %"),
    )  # fmt: skip
    if len(loops) > MAX_LOOPS:
        console.print(f"and {len(loops) - MAX_LOOPS} more: loopwright loops shows them all", highlight=False)
    console.print("loopwright check LOOPS.yaml asks each of them whether it answers.", highlight=False)
