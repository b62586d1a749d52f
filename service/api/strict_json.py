"""A strict JSON parser for requests and files.

Besides invalid JSON the parser refuses a duplicate key in an object (Python's parser would silently use the last
value), NaN, Infinity and numbers too large for a float, deep nesting, and text that a database cannot store. It skips a
byte order mark, because some editors write one.
"""

from __future__ import annotations

import json
import math
from collections import Counter

DEEPEST = 16
"""Maximum nesting of lists and objects. The deepest valid request has 4 levels."""


_LOOKED_AT = (str, float, dict, list)


class BadJson(ValueError):
    """The text is refused. where: the path to the invalid value by keys and indices; empty if there is none."""

    def __init__(self, why: str, where: tuple[str | int, ...] = ()) -> None:
        self.why = why
        self.where = ".".join(str(place)[:60] for place in where)
        super().__init__(f"{self.where}: {why}" if where else why)


def loads(text: str | bytes) -> object:
    """The parsed value. Bytes are decoded as UTF-8. Raises BadJson."""
    try:
        text = text.decode("utf-8-sig") if isinstance(text, bytes) else text.removeprefix("\ufeff")
        found: object = json.loads(text, object_pairs_hook=_object)
    except UnicodeDecodeError as error:
        raise BadJson(f"is not text in UTF-8: byte {error.start}") from None
    except json.JSONDecodeError as error:
        raise BadJson(f"not JSON: {error}") from None
    except RecursionError:
        raise BadJson(_too_deep()) from None
    except ValueError as error:  # an integer of thousands of digits
        raise BadJson(f"not a number that can be used: {error}") from None
    _check(found)
    return found


class _Twice(dict[str, object]):
    """An object with a duplicate key. Its path is known only after the whole text has been parsed."""

    key = ""


def _object(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) == len(pairs):
        return found
    twice = _Twice(found)
    twice.key = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
    return twice


def _check(found: object) -> None:
    """Raises BadJson with the path of an invalid value. It does not recurse, because the nesting may be deep."""
    waiting: list[tuple[object, tuple[str | int, ...]]] = [(found, ())]
    while waiting:
        value, where = waiting.pop()
        if isinstance(value, str):
            _check_text(value, where)
        elif isinstance(value, float):
            if not math.isfinite(value):
                raise BadJson("NaN, Infinity and what is beyond 1.8e308 are not numbers in JSON", where)
        elif isinstance(value, dict | list):
            if len(where) >= DEEPEST:
                raise BadJson(_too_deep(), where)
            if isinstance(value, _Twice):
                raise BadJson("this key is given twice: leave one of them out", (*where, value.key))
            if isinstance(value, dict):
                for key in value:
                    _check_text(key, where)
            places = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += ((part, (*where, place)) for place, part in places if isinstance(part, _LOOKED_AT))


def _check_text(text: str, where: tuple[str | int, ...]) -> None:
    if "\0" in text or (not text.isascii() and any("\ud800" <= c <= "\udfff" for c in text)):
        raise BadJson("text must not hold the character 0 or half of a surrogate pair", where)


def _too_deep() -> str:
    return f"lists and objects are nested more than {DEEPEST} deep"
