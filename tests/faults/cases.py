"""The table of faults: each is brought into each stage of a job, or into those named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from tests.e2e.plantsite import STAGES
from tests.faults import injections as do
from tests.faults.injections import AWAY_S, CLIENTS, LOCKED_S, Injection
from tests.faults.stand import Needs

BOTH = ("sqlite", "postgresql")
IN_MANUAL = tuple(name for name, stage in STAGES.items() if stage.in_manual)
PV_STAGES = ("fast-relay", "fast-verify", "setpoint-pulses", "setpoint-verify")
"""Stages that move the loop."""
NOISY = Needs(noise=0.002)
"""Noise tells whether PV is false: 2 % of the permitted step."""
ONE_PHASE = tuple(name for name in STAGES if name not in IN_MANUAL[1:])
"""For faults of the database and the like: to them all phases of a pulse of the manual output are the same."""


@dataclass(frozen=True)
class Fault:
    """words: what the table calls it.  stages: where it does not hang on the stage, those in which it is tried."""

    words: str
    inject: Injection
    stages: Sequence[str] = tuple(STAGES)
    databases: Sequence[str] = ("sqlite",)
    needs: Needs = field(default_factory=Needs)

    def runs(self) -> Iterator[tuple[str, str]]:
        """Database and stage of each run. What the second database changes, one phase of a pulse shows."""
        for database in self.databases:
            for stage in self.stages:
                if database == self.databases[0] or stage not in IN_MANUAL[1:]:
                    yield database, stage


FAULTS = {
    "service-killed": Fault("`kill -9` of the service, started again", do.service_killed, databases=BOTH),
    "plant-killed": Fault("`kill -9` of the plant, started again", do.plant_killed, databases=BOTH),
    "controller-killed": Fault("`kill -9` of the controller, started again", do.controller_killed, databases=BOTH),
    "defect": Fault("an exception that nobody expects", do.defect, IN_MANUAL, needs=Needs(defect=True)),
    "aborted": Fault("the operator aborts", do.aborted, IN_MANUAL),
    "sigterm": Fault("SIGTERM to the service, started again", do.service_stopped),
    "controller-reset": Fault("NMT reset of the controller", do.reset(CONTROLLER_NODE)),
    "plant-reset": Fault("NMT reset of the plant", do.reset(PLANT_NODE)),
    "bus-down-0.1": Fault("bus down for 0.1 s", do.bus_down(0.1)),
    "bus-down-1": Fault("bus down for 1 s", do.bus_down(1.0)),
    "bus-down-10": Fault("bus down for 10 s", do.bus_down(10.0)),
    "lost-1": Fault("1 % of the frames lost", do.frames(do.lost(0.01))),
    "lost-10": Fault("10 % of the frames lost", do.frames(do.lost(0.1))),
    "late-0.1": Fault("SDO answers 0.1 s late", do.frames(do.late_answers(0.1))),
    "late-5": Fault("SDO answers 5 s late", do.frames(do.late_answers(5.0))),
    "twice": Fault("every frame twice", do.frames(do.twice)),
    "senseless": Fault("frames that make no sense", do.senseless_frames),
    "wrong-pv": Fault("a PV of 1e30 and one that is no number", do.wrong_pv),
    "foreign-gains": Fault("another node tries other gains", do.foreign_gains),
    "foreign-mode": Fault("another node sets manual", do.foreign_mode),
    "foreign-setpoint": Fault("another node moves the set-point", do.foreign_setpoint),
    "foreign-output": Fault("another node moves the manual output", do.foreign_output, IN_MANUAL),
    "load": Fault("a load takes PV over the limit of the job", do.load, IN_MANUAL),
    "killed-twice": Fault("`kill -9` of the service, twice: again while it recovers", do.service_killed_twice),
    "off-1": Fault("the operator's OFF 1 sample after a command", do.operators_off(1)),
    "off-10": Fault("the operator's OFF 10 samples after a command", do.operators_off(10)),
    "off-40": Fault("the operator's OFF 40 samples after a command", do.operators_off(40)),
    "off-way-out": Fault("the operator's OFF on the way out", do.off_on_the_way_out),
    "pre-operational": Fault("a third node makes the controller pre-operational", do.pre_operational),
    "pv-gone": Fault("PV is no number for good", do.pv_gone),
    "pv-frozen": Fault("PV stands still within its limits for good", do.pv_false(None), PV_STAGES, needs=NOISY),
    "pv-jumps": Fault("PV jumps within its limits and stays there", do.pv_false(-0.6), PV_STAGES, needs=NOISY),
    "pv-frozen-clean": Fault("PV without noise stands still for good", do.pv_false(None), PV_STAGES),
    "pv-jumps-clean": Fault("PV without noise jumps with MV, and stays", do.pv_false(0.6), ("fast-relay",)),
    "two-tuners": Fault(
        "another tuner wants the loop", do.two_tuners, ("relay", "verify", "fast-relay", "setpoint-pulses", "manual-up")
    ),
    "second-gateway": Fault("`kill -9` at a slow sample time, beside another gateway", do.second_gateway),
    "deaf-listener": Fault("a listener that never reads", do.deaf_listener, ONE_PHASE),
    "disk-full": Fault(f"disk full for {AWAY_S:.0f} s", do.disk_full, ONE_PHASE, needs=Needs(small_disk=True)),
    "locked": Fault(
        f"database locked by another process for {LOCKED_S:.0f} s",
        do.database_locked(LOCKED_S),
        ONE_PHASE,
        databases=BOTH,
    ),
    "away": Fault(f"database away for {AWAY_S:.0f} s", do.database_away, ONE_PHASE, databases=BOTH),
    "restored": Fault(
        "database restored from a back-up made during the job",
        do.restored_backup,
        ("relay", "verify", "manual-up"),
        BOTH,
    ),
    "second-service": Fault("a second service on the same data", do.second_service, ("relay",), BOTH),
    "clock-back": Fault("wall clock set back an hour", do.clock_back, ONE_PHASE, needs=Needs(own_clock=True)),
    "clients": Fault(f"{CLIENTS} clients ask and abort at random", do.random_clients, ONE_PHASE),
}
