"""The faults of the watch after acceptance; each is tried at every moment of it, or at those named."""

from __future__ import annotations

from tests.faults import injections as do
from tests.faults import watch_injections as others
from tests.faults.cases import FAULTS, Fault
from tests.faults.injections import AWAY_S, LOCKED_S, Injection
from tests.faults.stand import Needs
from tests.faults.watch_ending import MOMENTS, OUTSIDE, WATCHED, WRITING


def _fault(words: str, inject: Injection, *moments: str, needs: Needs | None = None) -> Fault:
    return Fault(words, inject, moments or tuple(MOMENTS), needs=needs or Needs())


WATCH_FAULTS = {
    "watch-none": _fault("nothing", others.nothing, WATCHED),
    "watch-service-killed": _fault("`kill -9` of the service, started again", do.service_killed),
    "watch-sigterm": _fault("SIGTERM to the service, started again", do.service_stopped),
    "watch-controller-killed": _fault("`kill -9` of the controller, started again", do.controller_killed),
    "watch-controller-away": _fault("`kill -9` of the controller, gone for 10 s", others.controller_away),
    "watch-plant-killed": _fault("`kill -9` of the plant, started again", do.plant_killed, WATCHED),
    "watch-bus-down-1": _fault("bus down for 1 s", do.bus_down(1.0)),
    "watch-bus-down-10": _fault("bus down for 10 s", do.bus_down(10.0)),
    "watch-lost-10": _fault("10 % of the frames lost", do.frames(do.lost(0.1))),
    "watch-late-5": _fault("SDO answers 5 s late", do.frames(do.late_answers(5.0))),
    "watch-other-gains": _fault("another node makes other gains the accepted ones", others.other_gains),
    "watch-trial": _fault("another node has gains on trial", others.gains_on_trial),
    "watch-mode": _fault("another node sets manual", do.foreign_mode),
    "watch-mode-twice": _fault("manual for 5 s, then automatic again", others.manual_for_a_while, WATCHED),
    "watch-rolled-back": _fault("the operator rolls back as well", others.rolled_back, OUTSIDE, WRITING),
    "watch-locked": _fault(f"database locked by another process for {LOCKED_S:.0f} s", do.database_locked(LOCKED_S)),
    "watch-disk-full": _fault(f"disk full for {AWAY_S:.0f} s", do.disk_full, needs=Needs(small_disk=True)),
}
ALL_FAULTS = FAULTS | WATCH_FAULTS
