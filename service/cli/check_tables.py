"""Shows what `loopwright check` and `loopwright probe` have found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from loopwright.protocol.objects import Device
from loopwright.protocol.profile import node_name
from loopwright.service.cli.site_table import where
from loopwright.service.cli.terminal import console, rows
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.loops.bus_check import LoopCheck
from loopwright.service.loops.bus_probe import FoundNode


def show(found: Sequence[tuple[LoopConfig, LoopCheck]]) -> None:
    """Shows a table of the loops, then each problem in words."""
    rows(
        "loops",
        ("tag", "where", "answers", "mode", "SP", "PV", "unit", "MV %"),
        (_line(config, each) for config, each in found),
        never_cut=("tag", "answers", "mode", "MV %"),
    )
    for config, each in found:
        if each.problem is not None:
            console.print(f"{config.tag}: {each.problem}", highlight=False, soft_wrap=True)
    wrong = sum(each.problem is not None for _, each in found)
    console.print(
        f"{wrong} of {len(found)} loops cannot be read" if wrong else f"all loops answer ({len(found)})",
        highlight=False,
    )


def _line(config: LoopConfig, check: LoopCheck) -> tuple[object, ...]:
    state = check.state
    if state is None:
        return config.tag, where(config), "no", None, None, None, config.pv_unit, None
    return config.tag, where(config), "yes", state.mode.name.lower(), state.sp, state.pv, config.pv_unit, state.mv


def as_json(config: LoopConfig, check: LoopCheck) -> dict[str, object]:
    """Returns what was found of a loop as a JSON object."""
    state = check.state
    return {
        "tag": config.tag, "bus": config.bus, "controller_node": config.controller_node, "channel": config.channel,
        "answers": state is not None, "problem": check.problem,
        "mode": None if state is None else state.mode.name.lower(),
        "sp": None if state is None else state.sp,
        "pv": None if state is None else state.pv,
        "mv": None if state is None else state.mv,
    }  # fmt: skip


def show_nodes(bus: str, found: Sequence[FoundNode]) -> None:
    """Shows a table of the nodes of a bus, then each problem in words."""
    rows(
        f"nodes on {bus}",
        ("node", "is", "state", "channels", "sample time s"),
        (
            (
                node_name(each.node),
                "?" if each.device is None else each.device.value,
                each.state or "no heartbeat",
                each.channels,
                each.sample_time_s,
            )
            for each in found
        ),
    )
    for each in found:
        for problem in each.problems:
            text = f"node {node_name(each.node)}: {problem}"
            console.print(text, highlight=False, soft_wrap=True)
    if not any(each.device is Device.CONTROLLER for each in found):
        console.print("no controller that can be retuned answers on this bus", highlight=False)


def node_as_json(found: FoundNode) -> dict[str, object]:
    """Returns what was found of a node as a JSON object."""
    return asdict(found) | {"device": None if found.device is None else found.device.value}
