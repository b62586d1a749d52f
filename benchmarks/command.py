"""The command line of a benchmark: its help, its figures as one JSON object, or a sentence that says what it lacks."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Collection, Iterable

CANNOT = 125
"""Exit status, as tools/with-vcan has it: what is measured needs something that this machine does not have."""


class Missing(Exception):
    """What this machine does not have, in words."""


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """doc: of the module that is run; it is the help's text as it stands."""
    spec = sys.modules["__main__"].__spec__
    prog = f"python -m {spec.name.removesuffix('.__main__')}" if spec else None
    return argparse.ArgumentParser(prog=prog, description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def check_names(parser: argparse.ArgumentParser, kind: str, names: Iterable[str], known: Collection[str]) -> None:
    """Ends with one line when there is a name that nothing has."""
    for name in names:
        if name not in known:
            parser.exit(2, f"{parser.prog}: no {kind} is called {name!r}; known: {', '.join(known)}\n")


def command(doc: str | None, run: Callable[[], object]) -> None:
    """The whole command line of a benchmark without options."""
    parser_of(doc).parse_args()
    show(run)


def show(run: Callable[[], object]) -> None:
    try:
        print(json.dumps(run(), indent=1))
    except Missing as missing:
        print(missing, file=sys.stderr)
        sys.exit(CANNOT)
