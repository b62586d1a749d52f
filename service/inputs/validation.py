"""What is wrong with an input that pydantic has refused, in the words and places that its sender knows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import Tag, ValidationError

_BRANCH = "="
"""Begins the tag of a branch of a union: it stands in the place of an error, and is nothing that the sender wrote."""


def branch(kind: type) -> Tag:
    """Marks a class as a branch of a union; the discriminator of the union answers with `branch_of(kind)`."""
    return Tag(branch_of(kind))


def branch_of(kind: type) -> str:
    return _BRANCH + kind.__name__


def place(loc: Sequence[int | str]) -> str:
    """Where in the input, as body.model.K."""
    return ".".join(str(part) for part in loc if not str(part).startswith(_BRANCH))


def words(message: str) -> str:
    """A message of pydantic's, without what pydantic puts before ours."""
    return message.removeprefix("Value error, ")


def line(error: Any) -> str:
    """One of `ValidationError.errors()`: its place, unless the words begin with it, and the words."""
    where, told = place(error["loc"]), words(error["msg"])
    return told if told.startswith(where) else f"{where}: {told}"


def lines(error: ValidationError) -> str:
    return "; ".join(map(line, error.errors()))
