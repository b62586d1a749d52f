"""`loopwright rehearse`, which needs no service."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from loopwright.service.cli.output import (
    AsJson,
    AskedAim,
    AskedMvPeak,
    AskedNoiseGain,
    AskedSettling,
    AskedWeight,
    die,
    model_object,
    print_json,
)
from loopwright.service.cli.tuning import Plot, check_plot

if TYPE_CHECKING:
    from loopwright.service.execution.rehearsed import Rehearsal


def rehearse(
    plant_file: Annotated[
        str,
        typer.Argument(
            metavar="PLANT.json|FILE.py:NAME",
            help="Plant file, see docs/offline.md; a model such as K=2,T=10,L=3; or an object with step(mv) in a file.",
        ),
    ],
    method: Annotated[str, typer.Option(help="fast, setpoint, five-stage, or one of `loopwright methods`.")] = "fast",
    ms: Annotated[float | None, typer.Option(help="Ms that is designed for: 1.2 robust .. 1.6 .. 2.0 fast.")] = None,
    derivative: Annotated[
        bool, typer.Option("--derivative", help="Design a PID where it is better than a PI.")
    ] = False,
    aim: AskedAim = None,
    settling_s: AskedSettling = None,
    mv_peak: AskedMvPeak = None,
    noise_gain: AskedNoiseGain = None,
    setpoint_weight_max: AskedWeight = None,
    propose_anyway: Annotated[
        bool,
        typer.Option(
            "--propose-anyway", help="Propose the gains also where nothing asked for improves by more than 5 %."
        ),
    ] = False,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:
    """Rehearse the whole procedure on a plant model, or on a plant of your own in Python, in memory at full speed. Exit
    status 0: there is an answer; 2: the plant cannot be used."""
    from loopwright.service.api.report.words import stage_found, stage_name
    from loopwright.service.cli import job_tables, own_plants, terminal
    from loopwright.service.execution import rehearsal
    from loopwright.service.jsonable import to_json_object
    from loopwright.tuning.plan import Event, Note, StageDone
    from loopwright.tuning.reasons import Reason

    plant = own_plants.plant_of(plant_file)
    spec = model_object(plant_file, "the plant") if plant is None else {}

    def show(event: Event) -> None:
        text = f"note: {event.text}" if isinstance(event, Note) else None
        if isinstance(event, StageDone):
            found = stage_found(event.stage, to_json_object(event.result), "")
            text = f"{stage_name(event.stage)}: {found or 'done'}"
        if text is not None:
            terminal.progress_console.print(f"  {text}", highlight=False, soft_wrap=True)

    given = {
        "Ms": ms, "derivative": derivative or None, "aim": aim, "settling_s": settling_s, "mv_peak": mv_peak,
        "noise_gain": noise_gain, "setpoint_weight_max": setpoint_weight_max,
    }  # fmt: skip
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if options and method not in ("fast", "setpoint"):
        names = "--ms, --derivative, --aim, --settling-s, --mv-peak, --noise-gain and --setpoint-weight-max"
        die(f"{names} are options of the methods fast and setpoint, not of {method}", 2)
    check_plot(plot)
    on_event = None if as_json else show
    options["propose_anyway"] = propose_anyway
    if plant is None:
        found = rehearsal.rehearse(spec, method=method, on_event=on_event, **options)
    else:
        found = own_plants.retuned(plant_file, plant, method, on_event, options)
    if plot is not None:
        _save_rehearsal(plot, found, method)
    if as_json:
        print_json(found.as_json())
    else:
        job_tables.rehearsal_report(found)
    if found.ended is not None and found.ended.reason is Reason.BAD_INPUT and found.record is None:
        raise typer.Exit(2)


def _save_rehearsal(plot: Path, found: Rehearsal, method: str) -> None:
    from loopwright.service.cli.plots.job import NoPicture, job_picture
    from loopwright.service.cli.rehearsed import rehearsed_job, shown_samples
    from loopwright.service.execution.rehearsed import RehearsalRecord

    try:
        job_picture(
            plot, partial(shown_samples, found.record or RehearsalRecord()), rehearsed_job(found, method), "PV units"
        )
    except NoPicture as error:
        print(f"loopwright: no plot: {error}", file=sys.stderr)
    except OSError as error:
        die(f"{plot}: {error.strerror}", 2)
