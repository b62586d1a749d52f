"""Stored samples as columns."""

from __future__ import annotations

from typing import Any

from tuning.plan import Sample


def sample_columns(blocks: list[tuple[str, list[Sample]]]) -> dict[str, list[Any]]:
    """Columns of equal length, by the names of GET /jobs/{id}/samples."""
    flat = [sample for _, block in blocks for sample in block]
    return {
        "stage": [name for name, block in blocks for _ in block],
        "t_s": [sample.t for sample in flat],
        "sp": [sample.sp for sample in flat],
        "pv": [sample.pv for sample in flat],
        "mv": [sample.mv for sample in flat],
        "mode": [sample.mode for sample in flat],
    }
