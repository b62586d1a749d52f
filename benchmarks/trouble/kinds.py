"""Every kind of trouble at every level; `docs/trouble.md` says what each is.

What a procedure once proposed wrongly without a word comes first. Kinds whose trouble is the controller's, not the
plant's, are not here: nothing between MV and PV can be them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from benchmarks.trouble import plants, valves
from benchmarks.trouble.cases import FINE, NOISE, Made, Trouble, build
from benchmarks.trouble.chain import Part, Setting
from benchmarks.trouble.loads import Added, lagged_step, ramp, random_walk, sine
from benchmarks.trouble.processes import (
    ChangedGain,
    DriftingGain,
    Lag,
    Linear,
    Neighbour,
    Recirculation,
    SecondPath,
    SensorLag,
)
from benchmarks.trouble.sensors import Clipped, Coloured, Held, OnChange, Quantised

LATER = 4
"""Pu from which on a second path acts later than the record."""
LONGEST = 120.0
"""Of a run, Pu: so long a load is drawn."""
PATHS = (
    (0.3, 0.5), (0.3, 1), (0.3, 2), (0.3, 4), (0.3, 8), (0.6, 2), (0.6, 4), (-0.3, 1), (-0.3, 2), (-0.3, 4),
)  # fmt: skip
FREQUENCIES = (0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
NOISY = 0.05


def _noisy(level: str, noise: float) -> str:
    return level if noise == NOISE else f"{level}, {100.0 * noise:g} % noise"


def _each(*levels: tuple[float, Sequence[float]]) -> Iterator[tuple[float, float]]:
    """Each noise with each of its levels."""
    return ((noise, level) for noise, of_noise in levels for level in of_noise)


def beside_the_record() -> Iterator[Trouble]:
    """A second path, what comes back to the inlet, time constants far apart, a gain that drifts."""
    for share, later in PATHS:
        made = build(process=partial(SecondPath, share=share, later=later))
        yield Trouble("second path", f"{share:g} of the effect {later:g} Pu later", made, later=later >= LATER)
    for share in (0.3, 0.6, 0.8, -0.5):
        made = build(process=partial(Recirculation, share=share, later=LATER))
        yield Trouble("recirculation", f"{share:g} comes back {LATER} Pu later", made, later=True, substeps=4)
    for T in (20.0, 100.0):
        yield Trouble("slow lag", f"{T:g} s in series", build(), partial(plants.slower_lag, T_s=T))
        short = partial(plants.slower_lag, T_s=T, dead_time=0.1)
        yield Trouble("slow lag", f"{T:g} s in series, a tenth of the dead time", build(), short)
    for share in (0.3, 0.6):
        creeps = partial(plants.creep, share=share, T_s=100.0)
        yield Trouble("slow lag", f"{share:g} of the effect through 100 s", build(), creeps, later=True)
    for noise in (NOISE, NOISY):
        for end in (0.7, 0.9, 1.1, 1.3):
            made = build(before=partial(DriftingGain, end=end, over=8.0))
            yield Trouble("gain drifts over 8 Pu", _noisy(f"to {end:g}", noise), made, noise=noise)


def two_sides() -> Iterator[Trouble]:
    """What differs up and down, and curves."""
    for noise, below in _each((NOISE, (0.3, 0.5, 0.7, 0.85, 1.2, 1.5, 2.0, 3.0)), (NOISY, (0.5, 0.7, 1.5, 2.0))):
        made = build(before=_alone(valves.two_gains, below))
        yield Trouble("gain below over above", _noisy(f"{below:g}", noise), made, noise=noise)
    for noise, falls in _each((NOISE, (0.5, 0.7, 1.4, 2.0, 3.0)), (NOISY, (0.5, 2.0))):
        made = build(before=partial(_lag, falls=falls), process=_rest)
        yield Trouble("time constant down over up", _noisy(f"{falls:g}", noise), made, noise=noise, substeps=FINE)
    for noise, R in _each((NOISE, (10, 30, 50)), (NOISY, (30, 50))):
        made = build(before=_alone(valves.equal_percentage, R))
        yield Trouble("equal percentage valve", _noisy(f"R {R:g}", noise), made, noise=noise)
    for R in (30, 50):
        made = build(before=_alone(valves.equal_percentage, R))
        yield Trouble("equal percentage valve", f"R {R:g}, moved by 2.5 %", made, amplitude=2.5)
    for noise, opening in _each((NOISE, (15, 25, 50)), (NOISY, (15, 25))):
        made = build(before=_alone(valves.root, opening))
        yield Trouble("root valve", _noisy(f"{opening:g} % open", noise), made, noise=noise)
    for above in (2.0, 0.4):
        for at in (1, 2, 4):
            made = build(before=_alone(valves.broken, at, 1.0, above))
            yield Trouble("kinked valve", f"gain {above:g} from {at:g} % above rest on", made)
    for at_10 in (1.3, 1.6, 2.5, 0.6):
        made = build(before=_alone(valves.steeper_both_ways, at_10))
        yield Trouble("gain changes alike to both sides", f"{at_10:g} at 10 % MV", made)
    for slope in (1.5, 2, 3):
        made = build(after=_alone(valves.steep_middle, slope, 1.0, 0.0))
        yield Trouble("steep middle (pH)", f"{slope:g} times as steep within 1 % PV", made)
    for off in (1, 2, 4):
        made = build(after=_alone(valves.steep_middle, 3.0, 1.0, off))
        yield Trouble("steep middle (pH)", f"3 times as steep within 1 % PV, rest {off:g} % from it", made)
    for fall in (0.1, 0.3, 0.6):
        made = build(before=partial(valves.Transport, fall=fall), process=_without_dead_time)
        yield Trouble("transport", f"dead time falls by {fall:g} for 10 % MV", made, substeps=FINE)


def actuators() -> Iterator[Trouble]:
    """Speed, slack, ends, cycles."""
    for noise, stroke in _each((NOISE, (0.02, 0.05, 0.1, 0.2, 0.4)), (NOISY, (0.1, 0.2, 0.4))):
        made = build(before=partial(valves.RateLimit, stroke=stroke))
        yield Trouble("MV rate limit", _noisy(f"15 % takes {stroke:g} Pu", noise), made, noise=noise, substeps=FINE)
    for zone, stroke in ((0.3, 0.05), (0.3, 0.2), (1, 0.05), (1, 0.2), (2, 0.1)):
        made = build(before=partial(valves.RateLimit, stroke=stroke, dead_zone=zone))
        yield Trouble("motor valve", f"dead zone {zone:g} %, 15 % takes {stroke:g} Pu", made, substeps=FINE)
    for noise, slack in _each((NOISE, (0.2, 0.5, 1, 2)), (NOISY, (1, 2, 4))):
        made = build(before=partial(valves.backlash, slack=slack))
        yield Trouble("backlash", _noisy(f"{slack:g} % of MV", noise), made, noise=noise)
    for slack in (1, 2, 4):
        made = build(before=partial(valves.backlash, slack=slack), sensor=_alone(Quantised, 100.0 / 256.0))
        yield Trouble("backlash", f"{slack:g} % of MV, PV of 8 bits", made)
    for band in (0.2, 0.5, 1, 2):
        yield Trouble("stiction", f"S = J = {band:g} % of MV", build(before=partial(valves.stiction, band=band)))
    for part in (0.3, 0.5, 0.7, 0.9):
        made = build(before=_alone(valves.ends, -100.0, 10.0 * part))
        yield Trouble("valve ends", f"{10.0 * part:g} % above rest", made)
    for part in (0.2, 0.5):
        made = build(before=_alone(valves.ends, -5.0 * part, 100.0))
        yield Trouble("valve ends", f"{5.0 * part:g} % below rest", made)
    for cycle in (0.05, 0.1, 0.2, 0.4):
        made = build(before=partial(valves.TimeProportioned, cycle=cycle))
        yield Trouble("time-proportioned MV", f"cycle of {cycle:g} Pu", made, substeps=FINE)


def shapes() -> Iterator[Trouble]:
    """Linear plants of other shapes, the neighbour of a loop, few samples."""
    yield Trouble("none", "linear", build())
    yield Trouble("none", "5 % noise", build(), noise=NOISY)
    for samples in (8, 12, 20):
        yield Trouble("few samples", f"{samples} in Pu", build(), samples=samples)
    for frequency, damping in ((3.0, 0.1), (5.0, 0.05)):
        of = partial(plants.resonant, frequency=frequency, damping=damping)
        yield Trouble("resonance", f"at {frequency:g} ultimate frequencies, damping {damping:g}", build(), of)
    of = partial(plants.resonant, frequency=8.0, damping=0.01)
    for noise in (NOISE, 0.03):
        level = _noisy("at 8 ultimate frequencies, damping 0.01", noise)
        yield Trouble("resonance", level, build(), of, noise=noise)
    for frequency in (0.3, 0.6, 1.0):
        of = partial(plants.antiresonant, frequency=frequency, damping=0.05, apart=1.15)
        yield Trouble("lightly damped mode", f"at {frequency:g} ultimate frequencies, damping 0.05", build(), of)
    for kind in ("cosh", "mid", "near", "tanh"):
        yield Trouble("distributed heat", kind, build(), partial(plants.rod, kind=kind))
    for coupling in (0.3, 0.6, -0.5, -1.5):
        made = build(process=partial(Neighbour, coupling=coupling))
        yield Trouble("tight neighbour", f"coupling {coupling:g}", made)
    for steps in (2.0, 5.0):
        made = build(process=partial(Neighbour, coupling=0.3, steps=steps))
        yield Trouble("tight neighbour", f"coupling 0.3, its set-point steps by {steps:g} % in the test", made)


def changes() -> Iterator[Trouble]:
    """Plants that are others as the new gains take over."""
    for noise in (NOISE, NOISY):
        for size in (0.6, 1.3, 1.6):
            made = build(before=_alone(ChangedGain, size))
            yield Trouble("gain changes with the new gains", _noisy(f"x {size:g}", noise), made, noise=noise)
    for changed in (0.4, 0.6, 1.5, 2.5):
        made = build(before=partial(_lag, changed=changed), process=_rest)
        yield Trouble("lag changes with the new gains", f"x {changed:g}", made)
    for lag in (0.1, 0.2, 0.4):
        made = build(after=partial(SensorLag, before=0.0, after=lag))
        yield Trouble("sensor lag comes with the new gains", f"{lag:g} Pu", made)
    for lag in (0.1, 0.2):
        made = build(after=partial(SensorLag, before=lag, after=0.0))
        yield Trouble("sensor lag goes with the new gains", f"{lag:g} Pu", made)
    for coupling in (0.3, 0.6, -0.5):
        made = build(process=partial(Neighbour, coupling=coupling, to_manual=True))
        yield Trouble("neighbour goes to manual with the new gains", f"coupling {coupling:g}", made)


def disturbances() -> Iterator[Trouble]:
    """What moves PV besides MV, and sensors."""
    for size in (0.15, 0.25):
        for frequency in FREQUENCIES:
            made = build(after=partial(Added, of=sine(size, frequency), from_test=False))
            level = f"{size:g} % at {frequency:g} ultimate frequencies"
            # the larger one is seen where the noise is less
            noise = NOISE if size < 0.2 else 0.1 * NOISE
            yield Trouble("sine on PV", _noisy(level, noise), made, noise=noise)
    for frequency in (0.3, 0.7, 1.0, 1.4, 3.0):
        made = build(before=partial(Added, of=sine(0.3, frequency), from_test=False))
        yield Trouble("sine at the load", f"0.3 % of MV at {frequency:g} ultimate frequencies", made)
    for size in (0.05, 0.1, 0.2, 0.4):
        made = build(before=partial(_walk, size=size, from_test=False))
        yield Trouble("random-walk load", f"{size:g} % of MV after 1 Pu", made)
    for size in (0.1, 0.2, 0.4, 0.8, 1.6):
        made = build(before=partial(_walk, size=size, from_test=True))
        yield Trouble("random-walk load", f"{size:g} % of MV after 1 Pu, from the test on", made)
    for rate in (0.2, 0.5, 1.0, 2.0):
        made = build(before=partial(Added, of=ramp(rate), from_test=True))
        yield Trouble("ramp load", f"{rate:g} % of MV in Pu, from the test on", made)
    for lag in (0.3, 1.0, 3.0):
        made = build(before=partial(Added, of=lagged_step(1.5, 1.0, lag), from_test=True))
        yield Trouble("load step", f"1.5 % of MV through a lag of {lag:g} Pu", made)
    for size in (0.2, 0.5, 1.0, 2.0):
        made = build(after=partial(Added, of=lagged_step(size, 1.0, 1e-6), from_test=True))
        yield Trouble("sensor step", f"{size:g} % of PV in the test", made)
    for pole in (0.8, 0.9, 0.95, 0.98):
        made = build(noise=partial(Coloured, pole=pole))
        yield Trouble("coloured noise", f"3 %, pole {pole:g}", made, noise=0.03)
    for count in (4, 8, 16):
        made = build(sensor=partial(Held, count=count))
        yield Trouble("analyser", f"PV held {count} samples", made)
    for band in (0.1, 0.3, 1.0):
        yield Trouble("PV sent on change", f"of {band:g} %", build(sensor=_alone(OnChange, band)))
    for top in (2.0, 3.0, 4.0, 5.0):
        yield Trouble("PV clipped", f"{top:g} % above rest", build(sensor=_alone(Clipped, top)))


def _alone(made: Callable[..., Part], *parameters: float) -> Made:
    """A part that needs no setting."""
    return lambda setting: made(*parameters)


def _lag(setting: Setting, **of: float) -> Part:
    """The lag of 1 s that each of the plants has."""
    return Lag(setting.h, 1.0, **of)


def _rest(setting: Setting) -> Part:
    """The plant without that lag."""
    plant = setting.plant
    den, _ = np.polydiv(plant.den, (1.0, 1.0))
    return Linear(plant.num, tuple(den), plant.L, setting.h)


def _without_dead_time(setting: Setting) -> Part:
    plant = setting.plant
    return Linear(plant.num, plant.den, 0.0, setting.h)


def _walk(setting: Setting, size: float, from_test: bool) -> Part:
    return Added(setting, random_walk(setting, size, LONGEST), from_test)


TROUBLES = {
    each.name: each
    for kinds in (beside_the_record, two_sides, actuators, shapes, changes, disturbances)
    for each in kinds()
}
