"""Files that a power cut leaves whole: the one of before, or the new one once it is said to be there."""

from __future__ import annotations

import os
from pathlib import Path


def put_in_place(new: Path, target: Path) -> None:
    """Renames a file that is written; returns when it is on the disk under its new name, instead of what was there.
    Both are on one file system. Raises OSError."""
    sync(new)
    os.replace(new, target)
    sync(target.parent)


def sync(path: Path) -> None:
    """Returns when what a file holds, or which names a folder has, is on the disk. Raises OSError."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
