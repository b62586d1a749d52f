"""What `loopwright identify` does with a file of a loop in automatic, and how it asks for what is missing."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, NoReturn

import typer

from loopwright.service.cli.output import die, print_json

if TYPE_CHECKING:
    from loopwright.service.offline.automatic import InAutomatic
    from loopwright.service.offline.csv_record.record import Record
    from loopwright.tuning.identification.identify import Identified
    from loopwright.tuning.models import Model

GainsInEffect = tuple[float, float, float, float]
"""Kp, Ti, Td and b, ISA form; times in s."""


class AskedOfGains(NamedTuple):
    """What is asked of the gains, see `DesignSpec`."""

    ms: float
    settling_s: float | None
    mv_peak: float | None


@dataclass(frozen=True, slots=True)
class AskedOfFile:
    """What was typed after `loopwright identify`, so that it can be repeated with more.

    reading, given: the values of further options, by their names; None: not given. hold: that of --hold.
    """

    data: Path
    columns: Mapping[str, str]
    reading: Mapping[str, str | None]
    hold: bool | None
    tune: bool
    as_json: bool
    given: Mapping[str, float | None]

    def with_options(self, *options: str) -> str:
        """The command line with further options, to copy; they replace those that were given already."""
        words = ["loopwright", "identify", str(self.data)]
        columns = {f"--{name}": column for name, column in self.columns.items()}
        texts: dict[str, str | None] = {**columns, **self.reading}
        texts |= {name: None if value is None else f"{value:g}" for name, value in self.given.items()}
        for name, value in texts.items():
            words += [name, value] if value is not None and name not in options else []
        words += [] if self.hold is None else ["--hold" if self.hold else "--no-hold"]
        words += ["--tune"] * self.tune + ["--json"] * self.as_json
        return shlex.join([*words, *options])


def in_automatic_of(record: Record) -> InAutomatic | None:
    """Returns what the file shows of a controller that moved MV, None where nothing does."""
    from loopwright.service.offline.automatic import in_automatic

    return in_automatic(record)


def trusted(asked: AskedOfFile, automatic: InAutomatic, found: Identified) -> Identified:
    """Returns the model with a note on what it stands on, where it may be trusted; else asks for the gains."""
    from loopwright.service.offline.automatic import identified_as_it_is

    if not identified_as_it_is(found, automatic):
        ask_for_gains(asked, automatic)
    if not automatic.control.certain:
        return found
    note = f"{automatic.why}; the model explains PV to white noise, so that the record is identified as it is. "
    if automatic.options is not None:
        note += f"The checks of normal operation need the gains: {asked.with_options(*automatic.options)}"
    return replace(found, notes=(note.strip(), *found.notes))


def ask_for_gains(asked: AskedOfFile, automatic: InAutomatic | None, option: str | None = None) -> NoReturn:
    """Ends the command with what is to be typed, status 2.

    option: the option that says already that the loop was in automatic.
    """
    from loopwright.service.offline.automatic import GIVE

    why = f"{asked.data}: "
    if automatic is None:
        command = asked.with_options("--kp", "KP", "--ti", "TI")
        by_hand = "for a test in which MV was moved by hand leave it out"
        die(f"{why}{option} is of a loop in automatic and needs --kp ({GIVE}): {command}; {by_hand}", 2)
    why += automatic.why
    if automatic.options is None:
        text = f"{why}. What moved PV is not in such a file: take a time in which operators moved SP, step SP, or move "
        die(f"{text}MV by hand", 2)
    if option is None:
        why += ". A model from MV and PV alone may be wrong by what else moved PV: none of two lags leaves white noise"
    command = asked.with_options(*automatic.options)
    if not automatic.control.certain:
        die(f"{why}. In automatic: {command} ({GIVE}); a test signal: {asked.with_options('--open-loop')}", 2)
    if automatic.control.setpoint_moves is None:
        die(f"{why}. Export SP with it, and give the gains in effect: {command} ({GIVE})", 2)
    if automatic.control.gains is None:
        die(f"{why}. Give the gains in effect: {command} ({GIVE})", 2)
    die(f"{why}. Compare with the gains in the controller, then: {command}", 2)


def identify_operation(
    data: Path, record: Record, gains: GainsInEffect, asked: AskedOfGains, tune: bool, as_json: bool
) -> None:
    """Shows the gains that the set-point changes in a file propose; status 3 if there are none."""
    from loopwright.service.inputs.model_json import parse_model
    from loopwright.service.observing.exported import exported
    from loopwright.service.observing.observed import ObservationState
    from loopwright.tuning.fast.design.design import DesignSpec
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
    known = found.model is not None and found.state is not ObservationState.MISSING
    model = None
    if tune and known and found.model is not None:
        form = found.model
        model = parse_model({"num": list(form.num), "den": list(form.den), "dead_time_s": form.dead_time_s})
    if as_json:
        print_json({**found.model_dump(mode="json"), **({} if model is None else {"tunings": tunings_of(model)})})
    else:
        from loopwright.service.cli import observation_tables
        from loopwright.service.cli.terminal import console

        observation_tables.show_exported(found, console)
        if model is not None:
            show_tunings_of(model)
    if found.state is not ObservationState.PROPOSAL:
        raise typer.Exit(3)


def tunings_of(model: Model) -> dict[str, object]:
    """Returns the gains of all methods for a model, as `tune --json` prints them."""
    from loopwright.service.offline import tunings

    return tunings.tunings(model)


def show_tunings_of(model: Model) -> None:
    """Shows the gains of all methods for a model."""
    from loopwright.service.api.tuning_views import TuningsView
    from loopwright.service.cli import tuning_tables

    tuning_tables.tunings(TuningsView.model_validate(tunings_of(model)))
