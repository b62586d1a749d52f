"""`loopwright methods` and `tune`, which need no service."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from loopwright.service.cli.output import AsJson, die, model_object, print_json
from loopwright.service.offline.controller_forms import EQUATIONS, ISA_IN_S, VENDORS, BadForm, ControllerForm, Faceplate

_SHOWN = "How gains are shown"
PICTURES = (".png", ".svg", ".pdf")
Plot = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Write a plot: .png, .svg or .pdf.")]


def methods(as_json: AsJson = False) -> None:
    """Lists the tuning methods, what each is for and its options."""
    if as_json:
        from loopwright.service.offline import tunings

        print_json(tunings.methods_json())
        return
    from loopwright.service.cli import tuning_tables
    from loopwright.tuning.fast.known_plant.tuned import METHODS

    tuning_tables.methods(METHODS.values())


def tune(
    model: Annotated[
        str,
        typer.Option(metavar="MODEL|FILE", help="Model, such as K=2,T=10,L=3, the same as JSON, or its file."),
    ],
    method: Annotated[str, typer.Option(metavar="NAME", help="A method of `loopwright methods`, or all.")] = "all",
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Option of the method, such as lambda_s=5; may be repeated."),
    ] = None,
    form: Annotated[
        ControllerForm,
        typer.Option(
            help="Form of the controller that the gains are shown for.", rich_help_panel=_SHOWN,
        ),
    ] = ControllerForm.ISA,
    pv_span: Annotated[
        float | None,
        typer.Option(
            help="Span of PV, such as 200 for 0..200 degC: gains in per cent per per cent, as faceplates have them.",
            rich_help_panel=_SHOWN,
        ),
    ] = None,
    mv_span: Annotated[
        float, typer.Option(help="Span of MV, with --pv-span; 100 for an MV in per cent.", rich_help_panel=_SHOWN)
    ] = 100.0,
    minutes: Annotated[bool, typer.Option("--minutes", help="Times in minutes.", rich_help_panel=_SHOWN)] = False,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:  # fmt: skip
    one_thread()
    from loopwright.service.inputs.model_json import BadModel, parse_model
    from loopwright.service.offline import tunings

    check_plot(plot)
    try:
        faceplate = Faceplate(form, pv_span, mv_span, minutes)
    except BadForm as error:
        die(str(error), 2)
    if as_json and faceplate != ISA_IN_S:
        die("--json has the gains in ISA and in parallel form; --form, --pv-span and --minutes are for the table", 2)
    try:
        plant = parse_model(model_object(model, "--model"))
        found = tunings.tune_model(plant, method, dict(_option(text) for text in option or ()))
    except (BadModel, tunings.BadTuning) as error:
        die(str(error), 2)
    answer = tunings.answer(plant, found)
    if plot is not None:
        from loopwright.service.cli.plots.tunings import responses

        save(plot, responses, plant, found)
    if as_json:
        print_json(answer)
    else:
        from loopwright.service.api.tuning_views import TuningsView
        from loopwright.service.cli import tuning_tables

        tuning_tables.tunings(TuningsView.model_validate(answer), faceplate)
    if all(each.refusal is not None for each in found):
        raise typer.Exit(3)


tune.__doc__ = """Tunes a process model by one method or all, and compares the gains.

Exit status 0: gains found, 3: none.

The forms of the controller for --form, and where they are found (a block's own manual decides):

""" + "\n\n".join(f"{form.value}: {EQUATIONS[form]}; {VENDORS[form]}" for form in ControllerForm)


def one_thread() -> None:
    """Threads of the linear algebra cost more than they save on small matrices. To be called before numpy is loaded."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def check_plot(plot: Path | None) -> None:
    """Ends the command before any work if the format of the plot is not supported, its file cannot be written, or what
    draws it is not installed."""
    if plot is None:
        return
    if plot.suffix.lower() not in PICTURES:
        die(f"--plot must end in {', '.join(PICTURES)}, not {plot}", 2)
    if not plot.parent.is_dir():
        die(f"{plot}: {os.strerror(errno.ENOENT)}: make the folder {plot.parent} first, or name another", 2)
    if plot.is_dir() or not os.access(plot if plot.exists() else plot.parent, os.W_OK):
        die(f"{plot} cannot be written: name another file for --plot", 2)
    import_module("matplotlib")


def save(plot: Path, draw: Callable[..., None], *what: object) -> None:
    """Writes a plot; ends the command with status 2 where the file cannot be written."""
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
