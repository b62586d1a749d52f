"""A file that a command writes: whole, or as it was."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from loopwright.protocol.durable import put_in_place


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yields the path to write to; what was written there is `path` at the end. Where that fails, or the disk is full,
    the file that was there before is left as it was.

    Raises OSError.
    """
    target = Path(os.path.realpath(path))  # the link to a file stays a link
    if target.exists() and not target.is_file():  # a pipe or a device
        yield path
        return
    new = target.with_name(f".{target.stem}.{os.getpid()}{target.suffix}")
    try:
        yield new
        if target.exists():
            shutil.copymode(target, new)
        put_in_place(new, target)
    finally:
        with suppress(OSError):
            new.unlink(missing_ok=True)
