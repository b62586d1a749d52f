"""What is asked for, and what disturbs it: noise, loads, limits, a T95 that is wrong, and the like."""

from __future__ import annotations

import math
from dataclasses import dataclass

from benchmarks.disturbances import Disturbance
from benchmarks.plants import SAMPLES_PER_PERIOD, Plant
from loopwright.tuning.fast.design.design import DesignSpec

ASKED = 1.6
PI = DesignSpec(ASKED)
UNDISTURBED = Disturbance()


@dataclass(frozen=True, slots=True)
class Case:
    """noise: of the span.  derivative: PID.  lost: share of the samples that do not arrive.

    samples: in Pu.  known: T95 as it is said over 3 Pu.  adapted: so many times the amplitude is where MV ends, and the
    procedure finds the amplitude itself.  limits: of MV, amplitudes.  Mt, noise_gain: bounds on them, this in Ku.
    tail: Pu at the end of the record that are lost; what is left is judged anew, as for another Ms.
    directions: to which sides the set-point goes.  sp_rate: of the set-point, permitted steps in Pu.
    """

    name: str
    noise: float
    how: Disturbance = UNDISTURBED
    derivative: bool = False
    samples: int = SAMPLES_PER_PERIOD
    known: float = 1.0
    limits: float = 2.0
    adapted: bool = False
    lost: float = 0.0
    amplitude: float = 1.0
    nonlinear: bool = False
    Mt: float | None = None
    noise_gain: float | None = None
    tail: float = 0.0
    directions: str = "both"
    sp_rate: float = math.inf

    def spec(self, plant: Plant) -> DesignSpec:
        bound = None if self.noise_gain is None else self.noise_gain * plant.Ku
        return DesignSpec(ASKED, self.derivative, self.Mt, bound)


PLAIN = Case("", 0.0)
ONE, TWO = Disturbance(loads=1), Disturbance(loads=2)
TWO_SIDED = (0.5, 0.7, 0.85, 1.2, 1.5, 2.0)
CASES = {
    case.name: case
    for case in (
        Case("PI 0.5 %", 0.005),
        Case("PI 1 %", 0.01),
        Case("PI 2 %", 0.02),
        Case("PI 0.5 % + load", 0.005, ONE),
        Case("PI 1 % + load", 0.01, ONE),
        Case("PI 2 % + load", 0.02, ONE),
        Case("PID 1 %", 0.01, derivative=True),
    )
}
FURTHER = {
    case.name: case
    for case in (
        Case("noise 5 %", 0.05),
        Case("noise of pole 0.5", 0.01, Disturbance(pole=0.5)),
        Case("noise of pole 0.8", 0.01, Disturbance(pole=0.8)),
        Case("spikes, 1 in 100", 0.01, Disturbance(spikes=0.01)),
        Case("PV in steps of span/100", 0.005, Disturbance(quantum=0.01)),
        Case("PV in steps of span/50", 0.005, Disturbance(quantum=0.02)),
        Case("PV in steps of span/50, no noise", 0.0, Disturbance(quantum=0.02)),
        Case("drift 2 % in Pu", 0.01, Disturbance(drift=0.02)),
        Case("two loads", 0.01, TWO),
        Case("not at rest", 0.01, Disturbance(loads=1, unrest=True)),
        Case("valve sticks by 0.1", 0.01, Disturbance(stiction=0.1)),
        Case("valve sticks by 0.3", 0.01, Disturbance(stiction=0.3)),
        Case("dead band 0.05", 0.01, Disturbance(dead_band=0.05)),
        Case("dead band 0.2", 0.01, Disturbance(dead_band=0.2)),
        Case("actuator ends at 0.7", 0.01, Disturbance(ends=0.7)),
        Case("MV ends at 1.05", 0.01, limits=1.05),
        Case("amplitude found, much room", 0.01, limits=20.0, adapted=True),
        Case("amplitude found, little room", 0.01, limits=0.8, adapted=True),
        Case("T95 a tenth", 0.01, known=0.1),
        Case("T95 ten times", 0.01, known=10.0),
        Case("Ts = Pu/30", 0.01, samples=30),
        Case("Ts = Pu/100", 0.01, samples=100),
        Case("2 % of samples lost", 0.01, lost=0.02),
        Case("last 1.5 Pu lost", 0.01, tail=1.5),
        Case("last 2.5 Pu lost", 0.01, tail=2.5),
        Case("last 2.5 Pu lost, load", 0.01, ONE, tail=2.5),
        Case("gain doubles with the new gains", 0.01, Disturbance(gain=2.0)),
        Case("gain falls to 0.4 with them", 0.01, Disturbance(gain=0.4)),
        Case("dead time 0.25 Pu longer with them", 0.01, Disturbance(later=0.25)),
        *(Case(f"gain below {below:g} of that above", 0.01, Disturbance(below=below)) for below in TWO_SIDED),
        *(Case(f"equal percentage, R {R:g}", 0.01, Disturbance(rangeability=R), amplitude=10.0) for R in (10, 30, 50)),
        *(Case(f"root valve, {at:g} % open", 0.01, Disturbance(opening=at), amplitude=10.0) for at in (15, 25, 50)),
        Case("Mt at most 1.05", 0.01, Mt=1.05),
        Case("noise gain at most 0.25 Ku", 0.01, noise_gain=0.25),
        Case("PID, noise gain at most 2 Ku", 0.01, derivative=True, noise_gain=2.0),
        Case("nonlinear reactor, 5 %", 0.01, amplitude=5.0, nonlinear=True),
        Case("nonlinear reactor, 15 %", 0.01, amplitude=15.0, nonlinear=True),
    )
}
