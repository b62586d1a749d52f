"""What the histories came to: a log that can be read, and a table of kinds and endings."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable
from typing import Any

from loopwright.protocol.objects import Device, objects_of
from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    EMCY_FRAME,
    MV_FRAME,
    NMT_FRAME,
    NMT_ID,
    PLANT_NODE,
    PV_FRAME,
    STATUS_FRAME,
    SYNC_ID,
    Cause,
    Mode,
    NmtCommand,
    NmtState,
    channel_ids,
    emcy_id,
    heartbeat_id,
    sdo_request_id,
    sdo_response_id,
)
from tests.simulation.history import Ending
from tests.simulation.wire import Sent

_NAMES = {
    CONTROLLER_NODE: {entry.index: entry for entry in objects_of(Device.CONTROLLER)},
    PLANT_NODE: {entry.index: entry for entry in objects_of(Device.PLANT)},
}
_IDS = channel_ids(1, PLANT_NODE, CONTROLLER_NODE)
ENDINGS = ("proposed", "no_gain", "accepted", "rolled_back", "refused", "aborted", "failed", "interrupted", "queued",
           "running", "no job")  # fmt: skip


def in_words(at: float, who: str, what: Any) -> str:
    text = frame(what) if isinstance(what, Sent) else str(what)
    return f"{at:10.4f}  {who:<12}  {text}"


def frame(sent: Sent) -> str:
    """A frame as the profile reads it."""
    fate = f"   [{sent.fate}]" if sent.fate else ""
    try:
        return _said(sent.can_id, sent.data) + fate
    except (struct.error, ValueError, KeyError):
        return f"{sent.can_id:03X}h {sent.data.hex(' ')}{fate}"


def _said(can_id: int, data: bytes) -> str:
    if can_id == NMT_ID:
        command, node = NMT_FRAME.unpack(data)
        return f"NMT {NmtCommand(command).name.lower()} node {node:02X}h"
    if can_id == SYNC_ID:
        return "SYNC"
    if can_id == _IDS.pv:
        pv, n = PV_FRAME.unpack(data)
        return f"PV {pv:.5g} of sample {n}"
    if can_id == _IDS.mv:
        mv, n = MV_FRAME.unpack(data)
        return f"MV {mv:.5g} {f'for sample {n}' if n else 'unasked'}"
    if can_id == _IDS.status:
        mode, trial, sp, is_open, cause = STATUS_FRAME.unpack(data)
        words = f"{Mode(mode).name.lower()}, SP {sp:.5g}{', on trial' if trial else ''}"
        return f"status: {words}, {'session' if is_open else f'no session ({Cause(cause).name.lower()})'}"
    if can_id == _IDS.command:
        return f"RPDO set-point {struct.unpack('<f', data)[0]:.5g}"
    for node in (CONTROLLER_NODE, PLANT_NODE):
        if can_id == sdo_request_id(node):
            return _request(node, data)
        if can_id == sdo_response_id(node):
            return _answer(node, data)
        if can_id == emcy_id(node):
            code, register, detail = EMCY_FRAME.unpack(data)
            return f"EMCY {code:04X}h register {register:02X}h {detail.hex(' ')}"
    if 0x700 < can_id < 0x780:
        return f"heartbeat of {can_id - heartbeat_id(0):02X}h: {NmtState(data[0]).name.lower()}"
    return f"{can_id:03X}h {data.hex(' ')}"


def _request(node: int, data: bytes) -> str:
    command, index, sub = struct.unpack_from("<BHB", data)
    entry = _NAMES[node].get(index)
    name = entry.name if entry else f"{index:04X}h"
    if command == 0x40:
        return f"reads {name}"
    if entry is not None and command & 0xE0 == 0x20:
        value = entry.type_of(sub).decode(data[4 : 4 + entry.type_of(sub).size])
        shown = f"{value:08X}h" if isinstance(value, int) and value > 0xFFFF else f"{value:.6g}"
        return f"writes {name} = {shown}"
    return f"SDO {data.hex(' ')} ({name})"


def _answer(node: int, data: bytes) -> str:
    command, index, sub = struct.unpack_from("<BHB", data)
    entry = _NAMES[node].get(index)
    name = entry.name if entry else f"{index:04X}h"
    if command == 0x80:
        return f"answers {name}: abort {struct.unpack_from('<I', data, 4)[0]:08X}h"
    if command & 0xE0 == 0x60:
        return f"answers {name}: written"
    if entry is not None and command & 0xE0 == 0x40:
        value = entry.type_of(sub).decode(data[4 : 4 + entry.type_of(sub).size])
        shown = f"{value:08X}h" if isinstance(value, int) and value > 0xFFFF else f"{value:.6g}"
        return f"answers {name} = {shown}"
    return f"SDO answer {data.hex(' ')} ({name})"


def table(endings: Iterable[Ending]) -> list[list[str]]:
    """Kinds and how their first jobs ended; the last columns are what must be 0."""
    found: dict[str, Counter[str]] = {}
    for ending in endings:
        row = found.setdefault(ending.kind, Counter())
        row["histories"] += 1
        row[ending.ending] += 1
        row["internal"] += any(reason == "internal" for _, reason in ending.jobs)
        row["bad"] += bool(ending.bad)
    shown = ["histories", *ENDINGS, "internal", "bad"]
    rows = [["kind", *shown]]
    total: Counter[str] = Counter()
    for kind, row in found.items():
        rows.append([kind, *(str(row[name]) for name in shown)])
        total.update(row)
    return [*rows, ["all", *(str(total[name]) for name in shown)]]


def aligned(rows: list[list[str]]) -> str:
    widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))]
    lines = []
    for kind, *counts in rows:
        cells = (cell.rjust(width) for cell, width in zip(counts, widths[1:], strict=True))
        lines.append("  ".join((kind.ljust(widths[0]), *cells)))
    return "\n".join(lines)


def words(ending: Ending) -> str:
    return "; ".join(f"{each.at:.3f} s: {each.text}" for each in ending.bad)


def tell(ending: Ending) -> str:
    lines = [f"{ending.kind} {ending.seed}: {words(ending)}"]
    lines.append(f"    python -m tests.simulation --seed {ending.seed} --kind {ending.kind}")
    return "\n".join(lines)
