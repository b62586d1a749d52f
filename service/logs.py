"""Logs on standard error: lines for people, or one JSON object a line, with the job and loop they are about.

No key gets in: headers are never logged, and what looks like a key is struck out of every line.
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
from typing import Any, Literal

from service.security.keys import KEY_PATTERN
from service.store.clock import stamp

LogFormat = Literal["text", "json"]
FIELDS = ("job", "loop", "request", "who", "method", "path", "status", "ms", "address")
"""What a line may carry besides its message: from `about`, or from `extra`."""

_about: ContextVar[Mapping[str, Any]] = ContextVar("about", default=MappingProxyType({}))


@contextmanager
def about(**fields: Any) -> Iterator[None]:
    """Every line logged inside carries these fields."""
    token = _about.set({**_about.get(), **fields})
    try:
        yield
    finally:
        _about.reset(token)


def configure(log_format: LogFormat, level: int = logging.INFO) -> None:
    """The whole process logs this way from now on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if log_format == "json" else Lines())
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.captureWarnings(True)
    logging.getLogger("alembic").setLevel(logging.WARNING)


def fields_of(record: logging.LogRecord) -> dict[str, Any]:
    """The known fields of a record, its own first."""
    found = {**_about.get(), **{name: getattr(record, name) for name in FIELDS if hasattr(record, name)}}
    return {name: found[name] for name in FIELDS if found.get(name) is not None}


def without_keys(text: str) -> str:
    """The text with the secret part of every API key struck out."""
    return KEY_PATTERN.sub(r"lw_\1_***", text)


class JsonLines(logging.Formatter):
    """One JSON object a line."""

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
    """For people: time, level, message, then the fields as name=value."""

    def format(self, record: logging.LogRecord) -> str:
        at = stamp(datetime.fromtimestamp(record.created, UTC))
        line = " ".join(
            [at, record.levelname.lower(), record.getMessage(), *(f"{k}={v}" for k, v in fields_of(record).items())]
        )
        if record.exc_info:
            line += "\n" + self.formatException(record.exc_info)
        return without_keys(line)
