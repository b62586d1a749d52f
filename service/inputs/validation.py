"""Messages for input that pydantic has refused, with paths and words that the sender of the input knows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Annotated

from pydantic import BeforeValidator, ConfigDict, Tag, ValidationError
from pydantic_core import ErrorDetails

STRICT = ConfigDict(extra="forbid", strict=True)
"""Of what comes as JSON: a number is a number and not a text with digits, and true is no number. A list that is a tuple
here, and a word of a closed list, are declared with strict=False."""
ONE_LINE = r"^[^\x00-\x1f\x7f]*[^\x00-\x20\x7f][^\x00-\x1f\x7f]*$"
"""A name or a reason: one line of text that is not blank."""


def _whole(value: object) -> object:
    return int(value) if isinstance(value, float) and value.is_integer() else value


Whole = Annotated[int, BeforeValidator(_whole)]
"""A whole number of strict JSON, which knows no other kind of numbers: 3.0 is 3."""

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


def words(error: ErrorDetails, known: Sequence[str] = ()) -> str:
    """One of `ValidationError.errors()` in words, without its place.

    known: the names that the sender may have meant by an unknown one.
    """
    kind, context, given = error["type"], error.get("ctx", {}), _shown(error.get("input"))
    match kind:
        case "missing":
            return "it is missing"
        case "extra_forbidden":
            return f"unknown name{did_you_mean(str(error['loc'][-1]), known)}"
        case "greater_than" | "greater_than_equal" | "less_than" | "less_than_equal":
            bound = next(context[name] for name in ("gt", "ge", "lt", "le") if name in context)
            return f"{_COMPARED[kind]} {bound:g} is expected, not {given}"
        case "literal_error" | "enum":
            return f"{context['expected']} is expected, not {given}"
        case "string_pattern_mismatch":
            return f"{given} is not of the form {context['pattern']}"
    if kind in _EXPECTED:
        return f"{_EXPECTED[kind]} is expected, not {given}"
    return error["msg"].removeprefix("Value error, ")


_COMPARED = {
    "greater_than": "a number greater than",
    "greater_than_equal": "a number of at least",
    "less_than": "a number less than",
    "less_than_equal": "a number of at most",
}
_EXPECTED = {
    "float_type": "a number", "float_parsing": "a number", "finite_number": "a finite number",
    "int_type": "a whole number", "int_parsing": "a whole number", "int_from_float": "a whole number",
    "bool_type": "true or false", "bool_parsing": "true or false",
    "string_type": "a text",
    "list_type": "a list", "tuple_type": "a list",
    "dict_type": "a mapping of names to values", "model_type": "a mapping of names to values",
}  # fmt: skip
_LONGEST = 40
_MEANT = dict.fromkeys(("tau", "lag", "time_constant", "tc"), "T") | dict.fromkeys(
    ("theta", "dead_time", "deadtime", "delay", "td", "dead"), "L"
)
"""What models are called elsewhere."""
RENAMED = {
    "careful": "min_switches",
    "requested_by": "by",
    "roll_back_by_itself": "auto_rollback",
    "said_by": "by",
}
"""What the field calls what had another name before 0.1.0, where the spelling is too far apart to be found."""


def _shown(value: object) -> str:
    """Returns a value as its sender may recognise it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 4]} ..."


def did_you_mean(given: str, known: Sequence[str]) -> str:
    """Returns the question whether the most similar of the known names was meant; nothing where none is similar."""
    if (renamed := RENAMED.get(given)) is not None and (not known or renamed in known):
        return f"; did you mean {renamed}?"
    if (with_unit := f"{given}_s") in known:
        return f"; did you mean {with_unit}?"
    if (meant := _MEANT.get(given.lower().removesuffix("_s"))) is not None and f"{meant}_s" in known:
        return f"; did you mean {meant}_s?"
    alike = {name.lower(): name for name in known}
    found = get_close_matches(given.lower(), alike, 1)
    return f"; did you mean {alike[found[0]]}?" if found else ""


def listed(source: str, count: int, shown: Iterable[str]) -> str:
    """Returns the errors of a file as one text: their number, then the shown ones, each on a line."""
    return "\n".join([f"{source}: {count} {'error' if count == 1 else 'errors'}", *(f"  {text}" for text in shown)])


def line(error: ErrorDetails) -> str:
    """One of `ValidationError.errors()` as text: path and message, or the message alone if it begins with the path."""
    where, text = place(error["loc"]), words(error)
    return text if text.startswith(where) else f"{where}: {text}"


def lines(error: ValidationError) -> str:
    """All errors of a ValidationError as one text."""
    return "; ".join(map(line, error.errors()))
