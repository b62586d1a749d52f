"""What one computation may take of the machine, by its kind."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import IntEnum

MAX_AT_ONCE = 4
MB = 1 << 20


class ComputationKind(IntEnum):
    """What is computed. The least goes first: the others pause while it needs a processor."""

    LIVE = 0
    TUNING = 1
    DRY_RUN = 2


WORDS = {
    ComputationKind.LIVE: "the computation of a loop under test",
    ComputationKind.TUNING: "the tuning",
    ComputationKind.DRY_RUN: "the dry run",
}
OPTIONS = {
    ComputationKind.LIVE: "--live-cpu-s",
    ComputationKind.TUNING: "--tuning-cpu-s",
    ComputationKind.DRY_RUN: "--dry-run-cpu-s",
}
MEMORY_OPTION = "--computation-memory-mb"


@dataclass(frozen=True)
class ComputingLimits:
    """cpu_s: processor time of one computation, s. It is processor time, not wall time: a computation that pauses, or
    that other programs of the machine hold up, is not nearer to its limit for that.

    memory_mb: what one computation may ask of the system beyond the 100 MB or so that all of them share, MB (2^20 B).
    """

    live_cpu_s: int = 120
    tuning_cpu_s: int = 60
    dry_run_cpu_s: int = 300
    memory_mb: int = 512

    def cpu_s(self, kind: ComputationKind) -> int:
        return {
            ComputationKind.LIVE: self.live_cpu_s,
            ComputationKind.TUNING: self.tuning_cpu_s,
            ComputationKind.DRY_RUN: self.dry_run_cpu_s,
        }[kind]


def at_once() -> int:
    """How many computations this machine does at once: one processor is left for the bus and the requests."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(MAX_AT_ONCE, usable - 1))
