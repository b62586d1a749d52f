"""The units of times that are numbers, by the words that people have for them."""

from __future__ import annotations

import re

from loopwright.service.offline.csv_record.errors import Unusable

_WORDS = {
    1e-9: ("ns", "nsec", "nanosecond", "nanoseconds"),
    1e-6: ("us", "usec", "\u03bcs", "\u03bcsec", "microsecond", "microseconds"),
    1e-3: ("ms", "msec", "msecs", "millisecond", "milliseconds"),
    1.0: ("s", "sec", "secs", "second", "seconds"),
    60.0: ("min", "mins", "minute", "minutes"),
    3600.0: ("h", "hr", "hrs", "hour", "hours"),
    86400.0: ("d", "day", "days"),
}
SECONDS = {word: s for s, words in _WORDS.items() for word in words}
"""The seconds in a unit, by each word for it."""
_KNOWN = "ns, us, ms, s, min, h and d"
_NO_UNIT = re.compile(r"^(?:|utc|gmt|z|local|local time|(?:utc|gmt)?\s?[+-]\d{1,2}(?::?\d{2})?)$")
"""What stands in brackets behind the name of a time, and says nothing of its unit."""
_LATEST = 1e11
"""Seconds of three thousand years, beyond which a time has another unit than its column says."""


def seconds_in(unit: str) -> float | None:
    """Returns the seconds in a unit, None for one that is not known."""
    return SECONDS.get(_word(unit))


def unit_at_end(name: str) -> str:
    """Returns the unit of time that the name of a column ends with ("Elapsed_min", "Zeit / h", "ms"); "": none."""
    last = re.split(r"[\W_]+", _word(name))[-1]
    return last if last in SECONDS else ""


def require_known(unit: str, name: str) -> None:
    """Raises Unusable for what claims to be a unit and is none that is known."""
    if not _NO_UNIT.match(_word(unit)):
        raise Unusable(f"{name} has the unit {unit!r}, which is not known; {_put(name)}")


def require_possible(first_s: float, unit: str, name: str) -> None:
    """Raises Unusable for a first time so late that its unit must be another one."""
    if first_s > _LATEST:
        raise Unusable(f"{name} begins at {first_s:.4g} s, more than 3000 years, in the unit {unit!r}; {_put(name)}")


def _put(name: str) -> str:
    bare = re.split(r"\s*[(\[{]", name)[0] or name
    return f"put one of {_KNOWN} in its place, as in '{bare} (min)'"


def _word(text: str) -> str:
    return text.casefold().replace(".", "").strip()
