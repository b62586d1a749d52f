"""What the commands have in common: JSON in and out, and how they end when they cannot go on."""

from __future__ import annotations

import getpass
import json
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from loopwright.service.api import strict_json

Url = Annotated[str, typer.Option("--url", envvar="LOOPWRIGHT_URL", help="Where the service is.")]
AsJson = Annotated[bool, typer.Option("--json", help="JSON, for scripts.")]


def user() -> str:
    """Who gives the command, as the audit log names them."""
    try:
        return f"cli:{getpass.getuser()}"
    except (KeyError, OSError):
        return "cli:unknown"


def print_json(value: object) -> None:
    print(json.dumps(value, indent=2, allow_nan=False))


def on_terminal() -> bool:
    """Somebody is there to be asked."""
    return sys.stdin.isatty()


def die(text: str, status: int) -> NoReturn:
    print(f"loopwright: {text}", file=sys.stderr)
    raise typer.Exit(status)


def read_json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file; dies with status 2 for a file that has none."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        die(f"{path}: {error.strerror}", 2)
    except UnicodeDecodeError as error:
        die(f"{path}: is not text in UTF-8: byte {error.start}", 2)
    return json_object(text, str(path))


def json_object(text: str, source: str) -> dict[str, Any]:
    """The JSON object in a text; dies with status 2 if there is none. `source` names it in the error."""
    try:
        found = strict_json.loads(text)
    except strict_json.BadJson as error:
        die(f"{source}: {error}", 2)
    if not isinstance(found, dict):
        die(f"{source}: expected one JSON object", 2)
    return found
