"""Logs on standard error: lines for people, or one JSON object a line, with the job and loop they are about.

No API key is logged: headers are never logged, and text that looks like a key is removed from every line.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Literal

from loopwright.service.security.keys import KEY_PATTERN
from loopwright.service.store.clock import stamp

LogFormat = Literal["text", "json"]
FIELDS = ("job", "loop", "request", "key", "method", "path", "status", "ms", "address")
"""The fields that a line may have besides its message: from `about`, or from `extra`."""

_about: ContextVar[Mapping[str, object]] = ContextVar("about", default=MappingProxyType({}))


@contextmanager
def about(**fields: object) -> Iterator[None]:
    """Adds these fields to every line logged in this context."""
    token = _about.set({**_about.get(), **fields})
    try:
        yield
    finally:
        _about.reset(token)


def configure(log_format: LogFormat, level: int = logging.INFO) -> None:
    """Sets the form of the logs for the whole process."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if log_format == "json" else Lines())
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.captureWarnings(True)
    logging.getLogger("alembic").setLevel(logging.WARNING)


def fields_of(record: logging.LogRecord) -> dict[str, object]:
    """Returns the known fields of a record; its own ones take precedence."""
    values = {**_about.get(), **{name: getattr(record, name) for name in FIELDS if hasattr(record, name)}}
    return {name: values[name] for name in FIELDS if values.get(name) is not None}


def without_keys(text: str) -> str:
    """Returns the text without the secret part of any API key."""
    return KEY_PATTERN.sub(r"lw_\1_***", text)


class JsonLines(logging.Formatter):
    """Formats a record as one JSON object on one line."""

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "at": stamp(datetime.fromtimestamp(record.created, UTC)),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **fields_of(record),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return without_keys(json.dumps(line, default=str))


class Lines(logging.Formatter):
    """Formats a record for people: time, level, message, then the fields as name=value. Lines of a traceback are
    indented, so that every line without an indent is an entry, whatever text a caller has put into a path or a name."""

    def format(self, record: logging.LogRecord) -> str:
        at = stamp(datetime.fromtimestamp(record.created, UTC))
        fields = (f"{name}={_one_word(str(value))}" for name, value in fields_of(record).items())
        lines = [" ".join([at, record.levelname.lower(), escaped(record.getMessage()), *fields])]
        if record.exc_info:
            lines += ["  " + escaped(line) for line in self.formatException(record.exc_info).split("\n")]
        return without_keys("\n".join(lines))


def escaped(text: str) -> str:
    """Returns the text with every character that ends a line, is invisible or changes the direction of writing as its
    \\-sequence, so that a caller's text stays on its line of the log."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _one_word(value: str) -> str:
    """Returns the value in quotes where it would otherwise read as several fields."""
    value = escaped(value)
    return '"' + value.replace('"', r"\"") + '"' if any(c in value for c in ' "=') else value
