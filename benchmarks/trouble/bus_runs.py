"""What retunes through a bus came to, judged as the rehearsals are."""

from __future__ import annotations

from typing import Any

from benchmarks.trouble.bus_cases import REST
from benchmarks.trouble.bus_site import BusLoop
from benchmarks.trouble.chain import Chain, Setting
from benchmarks.trouble.kinds import TROUBLES
from benchmarks.trouble.response import Judged
from benchmarks.trouble.runs import TroubledRun
from loopwright.tuning.experiments.preflight import PREFLIGHT, SETTLE
from loopwright.tuning.gains import Gains

ON_BUS = "bus"
"""The method of such a run, beside those of the rehearsals."""
CUT_OFF = ("session_ended_by_device", "node_lost", "samples_lost", "bad_sample")
"""Reasons that are none of the procedure, on a bus without faults: the machine stood still for longer than a heartbeat,
a lease or a sample may be missing."""


def bus_run(loop: BusLoop, job: dict[str, Any], samples: dict[str, list[Any]]) -> TroubledRun:
    """job, samples: as the service has them, of a job that has ended."""
    passed = sum(stage not in (PREFLIGHT, SETTLE) for stage in samples["stage"]) / loop.plant.samples
    given = (loop.case.name, loop.plant.name, ON_BUS, loop.seed, passed, 0.0)
    if job["state"] != "proposed":
        return TroubledRun(*given, reason=job["reason"] or job["state"], detail=job["detail"] or "")
    new = job["new_gains"]
    gains = Gains(new["Kp"], new["Ti"], new["Td"], new["Tf"])
    worst = worst_of(loop, samples["mv"], gains)
    return TroubledRun(*given, Ms=worst.Ms if worst.stable else None, Kp=gains.Kp, Ti=gains.Ti)


def worst_of(loop: BusLoop, moved: list[float], gains: Gains) -> Judged:
    """The gains on the worst linearisation of the plant at the operating points that the recorded MV took it to.

    moved: MV, percent.
    """
    trouble = TROUBLES[loop.case.name]
    chain = Chain(Setting(loop.plant, trouble.substeps, loop.noise, loop.seed), trouble.build)
    chain.begin()
    for each in moved:
        chain.step(each - REST)
    chain.change()
    return chain.worst(gains)
