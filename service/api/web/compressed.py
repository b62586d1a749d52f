"""Text files compressed with gzip: each once, for as long as it stays as it is."""

from __future__ import annotations

import gzip
import re
from functools import lru_cache
from pathlib import Path

TEXTS = frozenset((".css", ".html", ".js", ".svg"))
"""Endings of the files that become smaller; a font and a picture are compressed already."""
_LEVEL = 9


def takes_gzip(accept_encoding: str) -> bool:
    """Whether the header Accept-Encoding names gzip, and not with q=0."""
    for each in accept_encoding.lower().split(","):
        name, _, weight = each.partition(";")
        if name.strip() == "gzip":
            return re.fullmatch(r"\s*q\s*=\s*0(\.0*)?\s*", weight) is None
    return False


def compressed(path: Path) -> bytes:
    """Returns the content of a file in the gzip format. Raises OSError."""
    present = path.stat()
    return _compressed(path, present.st_mtime_ns, present.st_size)


@lru_cache(maxsize=256)
def _compressed(path: Path, _mtime_ns: int, _size: int) -> bytes:
    return gzip.compress(path.read_bytes(), _LEVEL, mtime=0)
