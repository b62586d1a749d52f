"""`loopwright methods`, `tune` and `identify`, which need no service."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from loopwright.service.cli.output import AsJson, die, json_object, print_json, read_json_object

if TYPE_CHECKING:
    from loopwright.service.offline.csv_record import Record

PICTURES = (".png", ".svg", ".pdf")
Plot = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Write a plot: .png, .svg or .pdf.")]


def methods(as_json: AsJson = False) -> None:
    """Lists the tuning methods, what each is for and its options."""
    if as_json:
        from loopwright.service.offline import tunings

        print_json(tunings.methods_json())
        return
    from loopwright.service.cli import tuning_tables
    from loopwright.tuning.rules.registry import METHODS

    tuning_tables.methods(METHODS.values())


def tune(
    model: Annotated[
        str, typer.Option(metavar="JSON|FILE", help='Model, such as {"K": 2, "T_s": 10, "L_s": 3}, or its file.')
    ],
    method: Annotated[str, typer.Option(metavar="NAME", help="A method of `loopwright methods`, or all.")] = "all",
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Option of the method, such as lambda_s=5; may be repeated."),
    ] = None,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:
    """Tunes a process model by one method or all, and compares the gains. Exit status 0: gains found, 3: none."""
    _one_thread()
    from loopwright.service.inputs.model_json import BadModel, parse_model
    from loopwright.service.offline import tunings

    check_plot(plot)
    try:
        typed = model.lstrip().startswith(("{", "["))
        given = json_object(model, "--model") if typed else read_json_object(Path(model))
        plant = parse_model(given)
        found = tunings.tune_model(plant, method, dict(_option(text) for text in option or ()))
    except (BadModel, tunings.BadTuning) as error:
        die(str(error), 2)
    answer = tunings.answer(plant, found)
    if plot is not None:
        from loopwright.service.cli.plots.tunings import responses

        _save(plot, responses, plant, found)
    if as_json:
        print_json(answer)
    else:
        from loopwright.service.api.tuning_views import TuningsView
        from loopwright.service.cli import tuning_tables

        tuning_tables.tunings(TuningsView.model_validate(answer))
    if all(each.refusal is not None for each in found):
        raise typer.Exit(3)


def identify(
    data: Annotated[Path, typer.Argument(metavar="DATA.csv", help="Columns t, u (or mv), y (or pv).")],
    mv_before: Annotated[
        float | None, typer.Option(help="MV before the record; needed if the record begins with the move.")
    ] = None,
    plot: Plot = None,
    as_json: AsJson = False,
    closed_loop: Annotated[
        bool,
        typer.Option(
            "--closed-loop", help="The file is of normal operation in automatic, with a column sp; needs --kp."
        ),
    ] = False,
    kp: Annotated[float | None, typer.Option(help="Kp in effect, ISA form; with --closed-loop.")] = None,
    ti: Annotated[
        float | None, typer.Option(help="Ti in effect, s, with --closed-loop; default: no integral action.")
    ] = None,
    td: Annotated[float | None, typer.Option(help="Td in effect, s, with --closed-loop; default: 0.")] = None,
    b: Annotated[float | None, typer.Option(help="Set-point weight in effect, with --closed-loop; default: 1.")] = None,
    ms: Annotated[
        float | None, typer.Option(help="Ms that gains are designed for, with --closed-loop; default: 1.6.")
    ] = None,
) -> None:
    """Identifies a process model from a recorded test of any shape. Exit status 0: a model found, 3: none.

    With --closed-loop: gains from the set-point changes of normal operation, as `loopwright observe`. Exit status 0:
    gains are proposed, 3: none.
    """
    _one_thread()
    in_effect = (kp, ti, td, b, ms)
    if closed_loop and (kp is None or mv_before is not None or plot is not None):
        die("--closed-loop needs --kp, and takes neither --mv-before nor --plot", 2)
    if not closed_loop and any(each is not None for each in in_effect):
        die("--kp, --ti, --td, --b and --ms need --closed-loop", 2)
    from loopwright.service.offline.csv_record import RecordError, load_record
    from loopwright.service.offline.identification import identified, refused
    from loopwright.tuning.identification.identify import identify as fit
    from loopwright.tuning.reasons import Reason, Refused

    check_plot(plot)
    try:
        record = load_record(data)
    except RecordError as error:
        die(str(error), 2)
    if kp is not None:
        gains = (kp, ti or 0.0, td or 0.0, 1.0 if b is None else b)
        _identify_operation(data, record, gains, 1.6 if ms is None else ms, as_json)
        return
    try:
        found = fit(record.t, record.u, record.y, mv_before)
    except Refused as refusal:
        if refusal.reason is Reason.BAD_INPUT:
            die(f"{data}: {refusal.detail}", 2)
        if as_json:
            print_json(refused(refusal))
        else:
            from loopwright.service.cli import tuning_tables

            tuning_tables.not_identified(refusal)
        raise typer.Exit(3) from None
    if plot is not None:
        from loopwright.service.cli.plots.tunings import record_and_model

        _save(plot, record_and_model, record, found)
    if as_json:
        print_json(identified(found, record))
    else:
        from loopwright.service.cli import tuning_tables

        tuning_tables.identified(found, len(record.t))


def _identify_operation(
    data: Path, record: Record, gains: tuple[float, float, float, float], ms: float, as_json: bool
) -> None:
    from loopwright.service.observing.exported import exported
    from loopwright.service.observing.observed import ObservationState
    from loopwright.tuning.fast.design import DesignSpec
    from loopwright.tuning.gains import Gains
    from loopwright.tuning.reasons import Reason, Refused

    kp, ti, td, b = gains
    if not (math.isfinite(kp) and kp > 0.0 and math.isfinite(b) and all(0.0 <= each < math.inf for each in (ti, td))):
        die(f"--kp must be positive, --ti and --td at least 0, not {kp:g}, {ti:g}, {td:g}", 2)
    try:
        spec = DesignSpec(ms)
    except Refused as refusal:
        die(f"--ms: {refusal.detail}", 2)
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


def _one_thread() -> None:
    """Threads of the linear algebra cost more than they save on small matrices. To be called before numpy is loaded."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def check_plot(plot: Path | None) -> None:
    """Ends the command before any work if the format of the plot is not supported."""
    if plot is not None and plot.suffix.lower() not in PICTURES:
        die(f"--plot must end in {', '.join(PICTURES)}, not {plot}", 2)


def _save(plot: Path, draw: Callable[..., None], *what: object) -> None:
    try:
        draw(plot, *what)
    except OSError as error:
        die(f"{plot}: {error.strerror}", 2)


def _option(text: str) -> tuple[str, object]:
    """Returns name and value of "name=value"; the value is a number or a bool where it reads as one."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        die(f"--option must be NAME=VALUE, not {text!r}", 2)
    if value in ("true", "false"):
        return name, value == "true"
    for number in (int, float):
        try:
            return name, number(value)
        except ValueError:
            continue
    return name, value
