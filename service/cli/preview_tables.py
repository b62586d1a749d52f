"""Shows the preview of a retune on a terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from loopwright.service.api.report.words import stage_name
from loopwright.service.cli.terminal import number
from loopwright.service.planning.preview import FleetPreview, Preview, duration_text


def show(found: Preview | FleetPreview, console: Console) -> None:
    """Shows the preview of one loop or of many, and the obstacles of each."""
    for line in found.summary:
        console.print(line, highlight=False)
    if isinstance(found, FleetPreview):
        for each in found.loops:
            _obstacles(each, console)
        return
    _stages(found, console)
    _obstacles(found, console)


def _stages(found: Preview, console: Console) -> None:
    """Shows a table of the stages that move MV or the set-point."""
    moving = [each for each in found.stages if each.mv_move_pct or each.sp_move]
    if not moving:
        return
    table = Table("stage", "MV %", "SP", "PV", "plant time", "what is moved")
    for each in moving:
        table.add_row(
            stage_name(each.stage),
            _range(each.mv_low_pct, each.mv_high_pct, each.mv_move_pct),
            _range(each.sp_low, each.sp_high, each.sp_move),
            "not known" if each.pv_move is None else _range(each.pv_low, each.pv_high, each.pv_move),
            duration_text(each.duration_low_s, each.duration_high_s),
            each.what,
        )
    console.print(table)


def _obstacles(found: Preview, console: Console) -> None:
    if found.obstacles:
        console.print(Text.assemble((f"{found.loop} would be refused now", "bold"), ":"))
    for each in found.obstacles:
        console.print(f"  {each.reason}: {each.detail}\n    {each.advice}", highlight=False)


def _range(low: float | None, high: float | None, move: float) -> str:
    if not move:
        return ""
    return f"by {number(move)}" if low is None or high is None else f"{number(low)} .. {number(high)}"
