"""`loopwright identify`, which needs no service."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from loopwright.service.cli.automatic import (
    AskedOfFile,
    AskedOfGains,
    ask_for_gains,
    identify_operation,
    in_automatic_of,
    show_tunings_of,
    trusted,
    tunings_of,
)
from loopwright.service.cli.output import AsJson, die, print_json
from loopwright.service.cli.tuning import Plot, check_plot, one_thread, save

if TYPE_CHECKING:
    from loopwright.service.offline.automatic import InAutomatic
    from loopwright.service.offline.csv_record.record import ReadOptions, Record

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
    hold: Annotated[
        bool | None,
        typer.Option(
            "--hold/--no-hold",
            help="With --resample: PV holds its value until the next, as of a sensor that sends changes alone, or goes "
            "on in a straight line. Default: as the file shows.",
            show_default=False, rich_help_panel=_FILE,
        ),
    ] = None,
    every: Annotated[
        str | None,
        typer.Option(
            metavar="TIME", help="The lines come every 0.1s (or 500ms, 1min): no column of the time is read.",
            rich_help_panel=_FILE,
        ),
    ] = None,
    time_unit: Annotated[
        str | None,
        typer.Option(
            metavar="UNIT", help="Unit of times that are numbers: us, ms, s, min, h, d.", rich_help_panel=_FILE
        ),
    ] = None,
    closed_loop: Annotated[
        bool | None,
        typer.Option(
            "--closed-loop/--open-loop",
            help="The loop was in automatic, or MV was moved by hand or by a test signal. Default: as the file shows.",
            show_default=False, rich_help_panel=_CLOSED_LOOP,
        ),
    ] = None,
    kp: Annotated[
        float | None,
        typer.Option(help="Kp in effect, MV per PV, ISA form; the file needs SP.", rich_help_panel=_CLOSED_LOOP),
    ] = None,
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

    Normal operation in automatic: with the gains in effect (--kp, --ti, ...) gains are proposed from its set-point
    changes, as by `loopwright observe`. Exit status 0: gains are proposed, 3: none. Without them the command says
    what the file shows of the controller, and which options to add.
    """
    one_thread()
    given = {
        "--kp": kp, "--ti": ti, "--td": td, "--b": b, "--ms": ms, "--settling-s": settling_s, "--mv-peak": mv_peak
    }  # fmt: skip
    named = [name for name, value in given.items() if value is not None]
    if named and closed_loop is False:
        die(f"{', '.join(named)} and --open-loop exclude each other: these gains are those in automatic", 2)
    if kp is not None and (mv_before is not None or plot is not None):
        die("--kp takes neither --mv-before nor --plot: it answers with gains from normal operation", 2)
    check_plot(plot)
    columns = {name: column for name, column in (("t", t), ("u", u), ("y", y), ("sp", sp)) if column is not None}
    reading = {"--time-format": time_format, "--time-unit": time_unit, "--every": every, "--resample": resample}
    record = _load(data, _read_options(columns, reading, hold), as_json)
    asked = AskedOfFile(data, columns, reading, hold, tune, as_json, {**given, "--kp": None})
    if kp is not None:
        gains = (kp, ti or 0.0, td or 0.0, 1.0 if b is None else b)
        wanted = AskedOfGains(1.6 if ms is None else ms, settling_s, mv_peak)
        identify_operation(data, record, gains, wanted, tune, as_json)
        return
    automatic = None if closed_loop is False else in_automatic_of(record)
    if named or closed_loop:
        ask_for_gains(asked, automatic, ", ".join(named) or "--closed-loop")
    if automatic is not None and automatic.tells_nothing:
        ask_for_gains(asked, automatic)
    _identify_test(asked, record, automatic, mv_before, plot)


def _read_options(columns: dict[str, str], reading: Mapping[str, str | None], hold: bool | None) -> ReadOptions:
    from loopwright.service.offline.csv_record.record import ReadOptions
    from loopwright.service.offline.csv_record.sampling import duration
    from loopwright.service.offline.csv_record.time_units import KNOWN, seconds_in

    times: dict[str, float | None] = {}
    for option in ("--resample", "--every"):
        text = reading[option]
        try:
            times[option] = None if text is None else duration(text)
        except ValueError as error:
            die(f"{option}: {error}", 2)
    unit = reading["--time-unit"]
    if unit is not None and seconds_in(unit) is None:
        die(f"--time-unit: one of {KNOWN} is expected, not {unit!r}", 2)
    if reading["--every"] is not None:
        others = [name for name in ("--time-unit", "--time-format") if reading[name] is not None]
        others += ["--t"] if "t" in columns else []
        if others:
            die(f"--every and {others[0]} exclude each other: with --every no column of the time is read", 2)
    if hold is not None and reading["--resample"] is None:
        die("--hold and --no-hold say how samples are made: give --resample too, such as --resample 5s", 2)
    return ReadOptions(columns, reading["--time-format"], times["--resample"], times["--every"], unit, hold)


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
    asked: AskedOfFile, record: Record, automatic: InAutomatic | None, mv_before: float | None, plot: Path | None
) -> None:
    from loopwright.service.offline.identification import identified, refused
    from loopwright.tuning.identification.identify import identify as fit
    from loopwright.tuning.reasons import Reason, Refused

    try:
        found = fit(record.t, record.u, record.y, record.u_before if mv_before is None else mv_before)
    except Refused as refusal:
        if automatic is not None and automatic.control.certain:
            ask_for_gains(asked, automatic)
        if refusal.reason is Reason.BAD_INPUT:
            die(f"{asked.data}: {refusal.detail}", 2)
        if asked.as_json:
            print_json(refused(refusal, record))
        else:
            from loopwright.service.cli import tuning_tables

            tuning_tables.not_identified(refusal)
        raise typer.Exit(3) from None
    if automatic is not None:
        found = trusted(asked, automatic, found)
    if plot is not None:
        from loopwright.service.cli.plots.tunings import record_and_model

        save(plot, record_and_model, record, found)
    if asked.as_json:
        print_json({**identified(found, record), **({"tunings": tunings_of(found.model)} if asked.tune else {})})
        return
    from loopwright.service.cli import tuning_tables

    tuning_tables.identified(found, len(record.t))
    if asked.tune:
        show_tunings_of(found.model)
