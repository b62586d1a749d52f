"""Functions that the commands share: reading and printing JSON, and ending with an error."""

from __future__ import annotations

import getpass
import json
import os
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from loopwright.service.api import strict_json
from loopwright.service.cli.client import ApiError

Url = Annotated[str, typer.Option("--url", envvar="LOOPWRIGHT_URL", help="URL of the service.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]
AskedAim = Annotated[
    str | None,
    typer.Option("--aim", help="What gains of fast are best for: balanced (default), setpoint, load, no_overshoot."),
]
AskedSettling = Annotated[
    float | None,
    typer.Option("--settling-s", help="Longest time from a set-point step until PV stays within 5 %, s."),
]
AskedMvPeak = Annotated[
    float | None,
    typer.Option("--mv-peak", help="Largest change of MV after a set-point step, percent per PV unit."),
]
AskedNoiseGain = Annotated[
    float | None,
    typer.Option("--noise-gain", help="Largest immediate change of MV for a jump of PV, percent per PV unit."),
]
AskedWeight = Annotated[
    float | None,
    typer.Option("--setpoint-weight-max", help="Largest set-point weight b of the gains, 0 to 2; default: 1."),
]


def user() -> str:
    """Returns the user who runs the command, as the audit log names them."""
    try:
        return f"cli:{getpass.getuser()}"
    except (KeyError, OSError):
        return "cli:unknown"


def print_json(value: object) -> None:
    print(json.dumps(value, indent=2, allow_nan=False))


def on_terminal() -> bool:
    """Returns whether there is a terminal on which a question can be answered."""
    return sys.stdin.isatty()


def shown_on_terminal() -> bool:
    """Returns whether what is printed goes to a terminal, where somebody may read it at once."""
    return sys.stdout.isatty()


def die(text: str, status: int) -> NoReturn:
    print(f"loopwright: {text}", file=sys.stderr)
    raise typer.Exit(status)


@contextmanager
def going_on(what: str, next_steps: str) -> Iterator[None]:
    """Says how something is followed and ended further, where the command that follows it ends before it does: by
    Ctrl-C, or because the service is away."""
    try:
        yield
    except KeyboardInterrupt:
        die(f"{what} goes on; {next_steps}", 130)
    except ApiError as error:
        die(f"{error}\n{what} may go on; {next_steps}", 1)


def job_going_on(job_id: str) -> AbstractContextManager[None]:
    """As `going_on`, of a job."""
    command = f"loopwright job {job_id}"
    return going_on(f"job {job_id}", f"follow it with: {command} --follow, end it with: {command} --abort")


def read_json_object(path: Path) -> dict[str, object]:
    """Returns the JSON object in a file; ends the command with status 2 if there is none."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        die(f"{path}: {error.strerror}", 2)
    except UnicodeDecodeError as error:
        die(f"{path}: is not text in UTF-8: byte {error.start}", 2)
    return json_object(text, str(path))


def model_object(given: str, source: str) -> dict[str, object]:
    """Returns the model that a user has typed, as JSON or as K=2,T=10,L=3, or that is in a file; ends the command with
    status 2 if there is none.

    source: the name of what was typed in the error.
    """
    typed = given.lstrip().startswith(("{", "["))
    if typed or os.path.exists(given) or "=" not in given:
        return json_object(given, source) if typed else read_json_object(Path(given))
    from loopwright.service.inputs.model_json import named

    try:
        found = named(given)
    except ValueError as error:
        die(f"{source}: {error}", 2)
    assert isinstance(found, dict)
    return found


def json_object(text: str, source: str) -> dict[str, object]:
    """Returns the JSON object in a text; ends the command with status 2 if there is none.

    source: the name of the text in the error.
    """
    try:
        found = strict_json.loads(text)
    except strict_json.BadJson as error:
        curly = '; quotes in JSON are straight: "' if any(quote in text for quote in "“”„‘’«»") else ""
        die(f"{source}: {error}{curly}", 2)
    if not isinstance(found, dict):
        die(f"{source}: expected one JSON object", 2)
    return found
