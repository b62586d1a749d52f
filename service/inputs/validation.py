"""Messages for input that pydantic has refused, with paths and words that the sender of the input knows."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Tag, ValidationError
from pydantic_core import ErrorDetails

_BRANCH = "="
"""Prefix of the tag of a union's branch. The tag is part of an error's path, although the sender did not write it."""


def branch(kind: type) -> Tag:
    """Marks a class as a branch of a union; the discriminator of the union answers with `branch_of(kind)`."""
    return Tag(branch_of(kind))


def branch_of(kind: type) -> str:
    return _BRANCH + kind.__name__


def place(loc: Sequence[int | str]) -> str:
    """The path of an error in the input, such as body.model.K."""
    return ".".join(str(part) for part in loc if not str(part).startswith(_BRANCH))


def words(message: str) -> str:
    """A message of pydantic without the prefix that pydantic adds to the text of a ValueError."""
    return message.removeprefix("Value error, ")


def line(error: ErrorDetails) -> str:
    """One of `ValidationError.errors()` as text: path and message, or the message alone if it begins with the path."""
    where, text = place(error["loc"]), words(error["msg"])
    return text if text.startswith(where) else f"{where}: {text}"


def lines(error: ValidationError) -> str:
    """All errors of a ValidationError as one text."""
    return "; ".join(map(line, error.errors()))
