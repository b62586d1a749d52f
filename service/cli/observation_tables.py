"""Shows on a terminal what the history of a loop tells of its gains."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime

from rich.console import Console
from rich.table import Table

from loopwright.service.cli.terminal import cell
from loopwright.service.inputs.model_json import describe
from loopwright.service.observing.exported import ExportedView
from loopwright.service.observing.observed import ObservationView, ObservedChangeView, OperationView
from loopwright.service.results import FindingSource, KnownGainsView


def show(found: ObservationView, console: Console) -> None:
    """Shows what is known, from which changes, the gains and what speaks against them."""
    for line in _lines(found):
        console.print(line, highlight=False, soft_wrap=True)
    table = gains_table(found.present, found.proposed, f"% per {found.pv_unit}")
    for label, name, unit in (("overshoot", "overshoot_pct", "%"), ("settling", "settling_s", "s")):
        of_both = [
            None if each is None else getattr(each, name) for each in (found.predicted_previous, found.predicted)
        ]
        table.add_row(label, *map(cell, of_both), unit)
    console.print(table)
    if found.tested_text:
        console.print(found.tested_text, highlight=False)
        console.print("What `retune` stands for:", highlight=False)
        console.print(json.dumps(found.retune), highlight=False, soft_wrap=True)


def _lines(found: ObservationView) -> list[str]:
    heard = found.data
    lines = [f"{found.loop}: {found.known}; {found.detail}"]
    lines += [found.advice] if found.advice else []
    if heard.from_s is not None and heard.to_s is not None:
        lines.append(
            f"Data: {heard.duration_s:.4g} s in automatic within {_time(heard.from_s)} .. {_time(heard.to_s)}, "
            f"in samples of {heard.sample_s:.3g} s."
        )
    known = found.knowledge
    if known is not None and known.source is not FindingSource.OPERATION:
        lines.append(f"Known already: {known.text}, at {known.at}.")
    lines += [f"No data at present: {heard.no_data}"] if heard.no_data else []
    if heard.disturbed_by:
        lines.append(f"Left out: the times in which neighbours were under test ({', '.join(heard.disturbed_by)}).")
    for what, changes in (("used", found.changes_used), ("not used", found.changes_dropped)):
        lines += [f"Set-point changes {what}: {_changes(changes, found.pv_unit)}."] if changes else []
    lines += [f"Load found and allowed for: {each.size:+.3g} % at {_time(each.at_s)}." for each in found.loads]
    return [*lines, *_range(found, f" {found.pv_unit}", " %")]


def _range(found: OperationView, pv_unit: str = "", mv_unit: str = "") -> list[str]:
    if found.pv_range is None or found.mv_range is None:
        return []
    pv, mv = found.pv_range, found.mv_range
    return [
        f"The model holds for PV {pv.low:.5g} .. {pv.high:.5g}{pv_unit}, MV {mv.low:.4g} .. {mv.high:.4g}{mv_unit}."
    ]


def _changes(changes: Sequence[ObservedChangeView], pv_unit: str) -> str:
    return ", ".join(f"{_time(each.at_s)} ({each.size:.3g} {pv_unit})" for each in changes)


def show_exported(found: ExportedView, console: Console) -> None:
    """Shows what the file of a historian tells."""
    lines = [f"{found.known}; {found.detail}", *([found.advice] if found.advice else [])]
    lines.append(
        f"{found.samples} samples of {found.sample_time_s:.3g} s, the controller acts "
        f"{'reversely' if found.reverse_acting else 'directly'}."
    )
    for what, changes in (("used", found.changes_used), ("not used", found.changes_dropped)):
        shown = ", ".join(f"{each.t_s:.6g} s ({each.size:.3g})" for each in changes)
        lines += [f"Set-point changes {what}: {shown}."] if changes else []
    lines += _range(found)
    if found.model is not None:
        model = {name: getattr(found.model, name) for name in ("num", "den", "dead_time_s")}
        lines.append(f"Model ({found.model.named}): {describe(model)}.")
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)
    console.print(gains_table(found.present, found.proposed, "OP per PV"))


def gains_table(present: KnownGainsView, designed: KnownGainsView | None, unit_of_Kp: str) -> Table:
    """Gains with Ms, present and designed."""
    table = Table()
    for heading in ("", "present", "designed", "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for name, unit in (("Kp", f"{unit_of_Kp} (ISA)"), ("Ti", "s"), ("Td", "s"), ("b", "")):
        table.add_row(name, *(_gain(each, name) for each in (present, designed)), unit)
    table.add_row("Ms", _ms(present), _ms(designed), "")
    return table


def _gain(known: KnownGainsView | None, name: str) -> str:
    return "-" if known is None else cell(getattr(known.gains, name))


def _ms(known: KnownGainsView | None) -> str:
    return "-" if known is None or known.Ms is None else f"{known.Ms:.3g} +- {known.uncertainty:.2g}"


def _time(at_s: float) -> str:
    return datetime.fromtimestamp(at_s).isoformat(" ", "seconds")
