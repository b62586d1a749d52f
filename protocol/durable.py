"""Writing files so that a power cut leaves a whole file: the old one, or the new one once its writing has returned."""

from __future__ import annotations

import os
from pathlib import Path


def put_in_place(new: Path, target: Path) -> None:
    """Renames a finished file over its target; returns when the new name is on the disk.

    new, target: paths on the same file system.
    Raises OSError.
    """
    sync(new)
    os.replace(new, target)
    sync(target.parent)


def sync(path: Path) -> None:
    """Returns when the contents of a file, or the names in a folder, are on the disk. Raises OSError."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
