"""The units of times that are numbers, by the words that people have for them in English, German, French, Spanish."""

from __future__ import annotations

import re

import numpy as np

from loopwright.service.offline.csv_record.errors import Unusable
from loopwright.service.offline.csv_record.words import plain
from loopwright.tuning.models import Reals

_WORDS = {
    1e-9: ("ns", "nsec", "nanosecond", "nanoseconds"),
    1e-6: ("us", "usec", "\u03bcs", "\u03bcsec", "microsecond", "microseconds"),
    1e-3: (
        "ms", "msec", "msecs", "millis", "millisecond", "milliseconds", "millisekunde", "millisekunden",
        "milliseconde", "millisecondes", "milisegundo", "milisegundos",
    ),
    1.0: (
        "s", "sec", "secs", "second", "seconds", "sek", "sekunde", "sekunden", "seconde", "secondes", "seg", "segundo",
        "segundos",
    ),
    60.0: ("min", "mins", "minute", "minutes", "minuten", "minuto", "minutos"),
    3600.0: ("h", "hr", "hrs", "hour", "hours", "std", "stunde", "stunden", "heure", "heures", "hora", "horas"),
    86400.0: ("d", "day", "days", "tag", "tage", "jour", "jours", "dia", "dias"),
}  # fmt: skip
SECONDS = {word: s for s, words in _WORDS.items() for word in words}
"""The seconds in a unit, by each word for it."""
KNOWN = "ns, us, ms, s, min, h and d"
"""The units, for sentences."""
_NO_UNIT = re.compile(r"^(?:|utc|gmt|z|local|local time|(?:utc|gmt)?\s?[+-]\d{1,2}(?::?\d{2})?)$")
"""What stands in brackets behind the name of a time, and says nothing of its unit."""
USUAL_MINUTES = (1, 1.5, 2, 3, 5, 10, 15, 20, 30, 60, 120, 180, 240, 360, 480, 720, 1440)
"""Times between samples that are usual where they are a minute or longer, min."""
_SELDOM, _DAY = 50.0, 86400.0
"""Time between samples from which on they seldom come in anything but whole minutes, and a day, s."""
WEEK = 7.0 * _DAY
"""Length of a record from which on its unit of time is questioned, s."""
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


def require_s_likely(times: Reals, name: str) -> None:
    """Raises Unusable for times that no unit is said of and that are unlikely to be s: 0, 500, 1000."""
    steps = np.abs(np.diff(times))
    usual, length = (float(np.median(steps)), float(np.ptp(times))) if len(steps) else (0.0, 0.0)
    whole_minutes = any(abs(usual - 60.0 * minutes) < 0.01 * usual for minutes in USUAL_MINUTES)
    if length > WEEK or (usual >= _SELDOM and not whole_minutes):
        shown = f"{length / _DAY:.3g} d" if length > _DAY else f"{length / 3600.0:.3g} h"
        raise Unusable(
            f"{name} has no unit; as s its values come every {usual:.4g} s, {shown} in all. Say which unit it is: "
            f"--time-unit ms, or --time-unit s if that is so ({KNOWN})"
        )


def _put(name: str) -> str:
    bare = re.split(r"\s*[(\[{]", name)[0] or name
    return f"put one of {KNOWN} in its place, as in '{bare} (min)', or give it by --time-unit"


def _word(text: str) -> str:
    return plain(text.replace(".", ""))
