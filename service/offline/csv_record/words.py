"""Words as people type them, made comparable, and the words for on and off."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence

from loopwright.service.offline.csv_record.numbers import is_missing

ON = frozenset(
    {
        "on", "true", "yes", "run", "running", "started", "active", "ein", "an", "wahr", "ja", "aktiv", "marche",
        "vrai", "oui", "allume", "actif", "encendido", "verdadero", "si", "marcha", "activo", "activado",
    }
)  # fmt: skip
OFF = frozenset(
    {
        "off", "false", "no", "stop", "stopped", "inactive", "aus", "falsch", "nein", "inaktiv", "arret", "faux",
        "non", "eteint", "inactif", "apagado", "falso", "paro", "parado", "inactivo", "desactivado",
    }
)  # fmt: skip
"""Words for an output that is on, and for one that is off, as `plain` makes them."""
TWO_STATES = frozenset(
    {
        "open",
        "closed",
        "opened",
        "auf",
        "zu",
        "offen",
        "geschlossen",
        "ouvert",
        "ferme",
        "abierto",
        "cerrado",
        "high",
        "low",
    }
)
"""Words that tell neither: a valve that is closed passes nothing, a contact that is closed passes all."""


def plain(text: str) -> str:
    """Returns a word in small letters, without accents and with single spaces."""
    letters = unicodedata.normalize("NFKD", text.casefold())
    return " ".join("".join(each for each in letters if not unicodedata.combining(each)).split())


def is_on_or_off(cell: str) -> bool:
    """Whether a cell has a word for on or off."""
    return plain(cell) in ON or plain(cell) in OFF


def switched(cells: Sequence[str]) -> tuple[list[str], str] | None:
    """Returns a column of words for on and off as 1 and 0, and the words; None for any other column."""
    first = next((cell for cell in cells if not is_missing(cell)), "")
    if not is_on_or_off(first):
        return None
    words = {cell: plain(cell) for cell in dict.fromkeys(cells) if not is_missing(cell)}
    if any(word not in ON and word not in OFF for word in words.values()):
        return None
    figures = {cell: "1" if word in ON else "0" for cell, word in words.items()}
    said = ", ".join(f"{cell.strip()!r} as {figures[cell]}" for cell in words)
    return [figures.get(cell, cell) for cell in cells], said
