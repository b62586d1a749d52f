"""Limits of one computation, by its kind."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import IntEnum

MAX_AT_ONCE = 4
"""Largest number of computations that run at the same time."""
MB = 1 << 20


class ComputationKind(IntEnum):
    """The kinds of computation. The lowest value goes first: the others pause while it needs a processor."""

    LIVE = 0
    TUNING = 1
    DRY_RUN = 2
    LOOK = 3


WORDS = {
    ComputationKind.LIVE: "the computation of a loop under test",
    ComputationKind.TUNING: "the tuning",
    ComputationKind.DRY_RUN: "the dry run",
    ComputationKind.LOOK: "the look at the history of a loop",
}
OPTIONS = {
    ComputationKind.LIVE: "--live-cpu-s",
    ComputationKind.TUNING: "--tuning-cpu-s",
    ComputationKind.DRY_RUN: "--dry-run-cpu-s",
    ComputationKind.LOOK: "--tuning-cpu-s",
}
MEMORY_OPTION = "--computation-memory-mb"


@dataclass(frozen=True)
class ComputingLimits:
    """The limits of one computation.

    live_cpu_s, tuning_cpu_s, dry_run_cpu_s: processor time by kind, s. Times in which a computation pauses or other
    programs hold it up do not count.
    memory_mb: memory beyond the 100 MB or so that all computations share, MB (2^20 bytes).
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
            ComputationKind.LOOK: self.tuning_cpu_s,
        }[kind]


def at_once() -> int:
    """Returns how many computations this machine runs at once: one processor is left for the bus and the requests."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(MAX_AT_ONCE, usable - 1))
