"""What was computed of a job, as bytes."""

from __future__ import annotations

from typing import NamedTuple


class PackedFigures(NamedTuple):
    """The record and the designs of a job, packed; None where there is none."""

    record: bytes | None
    designs: bytes | None
