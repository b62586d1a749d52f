"""`loopwright identify`, which needs no service."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from loopwright.service.cli.output import AsJson, die, print_json
from loopwright.service.cli.tuning import Plot, check_plot, one_thread, save

if TYPE_CHECKING:
    from loopwright.service.offline.csv_record.record import ReadOptions, Record
    from loopwright.tuning.identification.identify import Identified

GainsInEffect = tuple[float, float, float, float]
"""Kp, Ti, Td and b, ISA form; times in s."""
_FILE, _CLOSED_LOOP = "How the file is to be read", "Normal operation in automatic"


def identify(
    data: Annotated[
        Path, typer.Argument(metavar="DATA.csv", help="Columns of time, MV (OP, CO, u) and PV (y), perhaps SP.")
    ],
    mv_before: Annotated[
        float | None, typer.Option(help="MV before the record; needed if the record begins with the move.")
    ] = None,
    tune: Annotated[bool, typer.Option("--tune", help="Go on to gains: all methods on the model found.")] = False,
    plot: Plot = None,
    as_json: AsJson = False,
    t: Annotated[
        str | None,
        typer.Option("--t", metavar="COLUMN", help="Column of the time: name or number.", rich_help_panel=_FILE),
    ] = None,
    u: Annotated[
        str | None, typer.Option("--u", metavar="COLUMN", help="Column of MV: name or number.", rich_help_panel=_FILE)
    ] = None,
    y: Annotated[
        str | None, typer.Option("--y", metavar="COLUMN", help="Column of PV: name or number.", rich_help_panel=_FILE)
    ] = None,
    sp: Annotated[
        str | None,
        typer.Option("--sp", metavar="COLUMN", help="Column of the set-point: name or number.", rich_help_panel=_FILE),
    ] = None,
    time_format: Annotated[
        str | None,
        typer.Option(
            metavar="FORMAT", help="How times are written, such as '%d.%m.%Y %H:%M:%S'.", rich_help_panel=_FILE
        ),
    ] = None,
    resample: Annotated[
        str | None,
        typer.Option(
            metavar="TIME", help="Make a sample every 5s (or 500ms, 1min) from samples that are not even.",
            rich_help_panel=_FILE,
        ),
    ] = None,
    closed_loop: Annotated[
        bool,
        typer.Option(
            "--closed-loop", help="The file is of normal operation in automatic, with a column of SP; needs --kp.",
            rich_help_panel=_CLOSED_LOOP,
        ),
    ] = False,
    kp: Annotated[float | None, typer.Option(help="Kp in effect, ISA form.", rich_help_panel=_CLOSED_LOOP)] = None,
    ti: Annotated[
        float | None, typer.Option(help="Ti in effect, s; default: no integral action.", rich_help_panel=_CLOSED_LOOP)
    ] = None,
    td: Annotated[
        float | None, typer.Option(help="Td in effect, s; default: 0.", rich_help_panel=_CLOSED_LOOP)
    ] = None,
    b: Annotated[
        float | None, typer.Option(help="Set-point weight in effect; default: 1.", rich_help_panel=_CLOSED_LOOP)
    ] = None,
    ms: Annotated[
        float | None, typer.Option(help="Ms that gains are designed for; default: 1.6.", rich_help_panel=_CLOSED_LOOP)
    ] = None,
    settling_s: Annotated[
        float | None,
        typer.Option(
            help="Longest time from a set-point step until PV stays within 5 %, s.", rich_help_panel=_CLOSED_LOOP
        ),
    ] = None,
    mv_peak: Annotated[
        float | None,
        typer.Option(
            help="Largest change of MV after a set-point step, MV units per PV unit.", rich_help_panel=_CLOSED_LOOP
        ),
    ] = None,
) -> None:  # fmt: skip
    """Identifies a process model from a recorded test of any shape. Exit status 0: a model found, 3: none.

    With --closed-loop: gains from the set-point changes of normal operation, as `loopwright observe`. Exit status 0:
    gains are proposed, 3: none.
    """
    one_thread()
    if closed_loop and (kp is None or mv_before is not None or plot is not None or tune):
        die("--closed-loop needs --kp, and takes neither --mv-before nor --plot nor --tune: it answers with gains", 2)
    if not closed_loop and any(each is not None for each in (kp, ti, td, b, ms, settling_s, mv_peak)):
        die("--kp, --ti, --td, --b, --ms, --settling-s and --mv-peak need --closed-loop", 2)
    check_plot(plot)
    columns = {name: column for name, column in (("t", t), ("u", u), ("y", y), ("sp", sp)) if column is not None}
    record = _load(data, _read_options(columns, time_format, resample), as_json)
    if kp is not None:
        gains = (kp, ti or 0.0, td or 0.0, 1.0 if b is None else b)
        asked = _Asked(1.6 if ms is None else ms, settling_s, mv_peak)
        _identify_operation(data, record, gains, asked, as_json)
    else:
        _identify_test(data, record, mv_before, tune, plot, as_json)


def _read_options(columns: dict[str, str], time_format: str | None, resample: str | None) -> ReadOptions:
    from loopwright.service.offline.csv_record.record import ReadOptions
    from loopwright.service.offline.csv_record.sampling import duration

    try:
        return ReadOptions(columns, time_format, None if resample is None else duration(resample))
    except ValueError as error:
        die(f"--resample: {error}", 2)


def _load(data: Path, options: ReadOptions, as_json: bool) -> Record:
    """Returns the record in the file, and shows what was read; ends the command with status 2 if it cannot be used."""
    from loopwright.service.offline.csv_record.errors import RecordError
    from loopwright.service.offline.csv_record.record import load_record
    from loopwright.service.offline.csv_record.swapped import may_be_swapped

    try:
        record = load_record(data, options)
    except RecordError as error:
        die(str(error), 2)
    if not as_json:
        from loopwright.service.cli import record_tables

        record_tables.read(record)
    if may_be_swapped(record):
        mv, pv = record.names["u"], record.names["y"]
        why = f"{data}: are the columns swapped? MV ({mv}) is smooth and PV ({pv}) jumps, as if PV had been moved and "
        why += f'MV had followed. Say which is which: --u "{pv}" --y "{mv}"'
        if not {"u", "y"} <= options.columns.keys():
            die(f'{why}, or --u "{mv}" --y "{pv}" if they are right', 2)
        print(f"note: {why}; it goes on with the columns that were named", file=sys.stderr)
    return record


def _identify_test(
    data: Path, record: Record, mv_before: float | None, tune: bool, plot: Path | None, as_json: bool
) -> None:
    from loopwright.service.offline.identification import identified, refused
    from loopwright.tuning.identification.identify import identify as fit
    from loopwright.tuning.reasons import Reason, Refused

    try:
        found = fit(record.t, record.u, record.y, mv_before)
    except Refused as refusal:
        if refusal.reason is Reason.BAD_INPUT:
            die(f"{data}: {refusal.detail}", 2)
        if as_json:
            print_json(refused(refusal, record))
        else:
            from loopwright.service.cli import tuning_tables

            tuning_tables.not_identified(refusal)
        raise typer.Exit(3) from None
    if plot is not None:
        from loopwright.service.cli.plots.tunings import record_and_model

        save(plot, record_and_model, record, found)
    if as_json:
        print_json({**identified(found, record), **({"tunings": _tunings(found)} if tune else {})})
        return
    from loopwright.service.cli import tuning_tables

    tuning_tables.identified(found, len(record.t))
    if tune:
        from loopwright.service.api.tuning_views import TuningsView

        tuning_tables.tunings(TuningsView.model_validate(_tunings(found)))


def _tunings(found: Identified) -> dict[str, object]:
    from loopwright.service.offline import tunings

    return tunings.tunings(found.model)


class _Asked(NamedTuple):
    """What is asked of the gains, see `DesignSpec`."""

    ms: float
    settling_s: float | None
    mv_peak: float | None


def _identify_operation(data: Path, record: Record, gains: GainsInEffect, asked: _Asked, as_json: bool) -> None:
    from loopwright.service.observing.exported import exported
    from loopwright.service.observing.observed import ObservationState
    from loopwright.tuning.fast.design import DesignSpec
    from loopwright.tuning.gains import Gains
    from loopwright.tuning.reasons import Reason, Refused

    kp, ti, td, b = gains
    if not (math.isfinite(kp) and kp > 0.0 and math.isfinite(b) and all(0.0 <= each < math.inf for each in (ti, td))):
        die(f"--kp must be positive, --ti and --td at least 0, not {kp:g}, {ti:g}, {td:g}", 2)
    try:
        spec = DesignSpec(asked.ms, settling_s=asked.settling_s, mv_peak=asked.mv_peak)
    except Refused as refusal:
        die(f"{'--ms: ' if refusal.detail.startswith('Ms') else ''}{refusal.detail}", 2)
    try:
        found = exported(record, Gains(kp, ti, td, td / 10.0, b), spec)
    except Refused as refusal:
        die(f"{data}: {refusal.detail}", 2 if refusal.reason is Reason.BAD_INPUT else 3)
    if as_json:
        print_json(found.model_dump(mode="json"))
    else:
        from loopwright.service.cli import observation_tables
        from loopwright.service.cli.terminal import console

        observation_tables.show_exported(found, console)
    if found.state is not ObservationState.PROPOSAL:
        raise typer.Exit(3)
