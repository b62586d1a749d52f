"""The kinds of history: what goes wrong in each, and how many of a hundred histories are of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from random import Random

from loopwright.protocol.profile import Mode
from tests.simulation import faults
from tests.simulation.history import Ending, Loop, World


@dataclass(frozen=True)
class Kind:
    """weight: how many of a hundred histories are of it.  real: it runs a real procedure, on a quick loop."""

    words: str
    weight: int
    draw: Callable[[World], None]
    real: bool = False


KINDS: dict[str, Kind] = {
    "calm": Kind("nothing goes wrong, or a person aborts", 2, faults.calm),
    "kills": Kind("the service is killed 1 to 3 times before any call, in recovery too", 12, faults.kills),
    "false_pv": Kind("PV false within its limits: still, or elsewhere; and one of all that", 3, faults.false_pv),
    "frames": Kind("frames lost, doubled, late; kills", 6, faults.bad_frames),
    "away": Kind("the bus away, holding frames back, or its interface down; kills", 7, faults.bus_away),
    "held": Kind("the service dies while its frames are held back", 6, faults.held),
    "stalls": Kind("service, controller or plant stands still; kills", 5, faults.stalling),
    "restarts": Kind("controller or plant off and on again, with and without keep; kills", 6, faults.restarting),
    "nmt": Kind("NMT commands of a third node; kills", 6, faults.third_node),
    "tuners": Kind("two gateways on one loop, one of them killed", 9, faults.two_tuners),
    "operator": Kind("an operator moves mode, set-point, output, gains, limits; a PLC, kills", 10, faults.operators),
    "cascade": Kind("a PLC sends the set-point by RPDO, repeated or moved", 3, faults.cascade),
    "pv": Kind("PV no number, far off, standing still or silent; lost frames, kills", 6, faults.no_pv),
    "stranger": Kind("frames of the tuner sent once more, orders of a stranger; kills", 4, faults.strangers),
    "decisions": Kind("acceptance and rollback cut anywhere and asked again", 6, faults.decisions),
    "power": Kind("power cuts of the controller, in a write of its disk too", 3, faults.power_cuts),
    "mixed": Kind("two to four of all that at once", 3, faults.everything),
    "fast": Kind("the real fast procedure, with one of all that", 1, faults.real_fast, real=True),
    "setpoint": Kind("real pulses of the set-point, with one of all that", 1, faults.real_setpoint, real=True),
    "manual": Kind(
        "real pulses of the manual output, with one of all that in any phase",
        1,
        faults.real_manual,
        real=True,
    ),
    "five_stage": Kind("the real five-stage procedure, with one of all that", 0, faults.real_five_stage, real=True),
    "trial": Kind("a real set-point trial, with one of all that", 1, faults.real_trial, real=True),
    "watched": Kind(
        "accepted gains under which PV leaves its limits or oscillates, the watch, and one of all that",
        0,
        faults.after_acceptance,
        real=True,
    ),
}


def world(kind: str, seed: int, keeps_log: bool = False) -> World:
    """The history of a seed, ready to be run."""
    loop = None
    if KINDS[kind].real:
        random = Random(f"{kind} {seed} loop")
        Ts, pace = random.choice(((0.1, 10.0), (0.1, 0.0), (1.0, 100.0), (0.02, 1.0)))
        mode = Mode.MANUAL if kind == "manual" else Mode.AUTOMATIC
        loop = Loop(Ts, pace, mode, 50.0, 50.0, random.choice((0.0, 0.005, 0.02)), random.random() < 0.5, 100)
    made = World(kind, seed, loop, keeps_log)
    KINDS[kind].draw(made)
    return made


def play(kind: str, seed: int, keeps_log: bool = False) -> Ending:
    from tests.simulation.report import in_words

    made = world(kind, seed, keeps_log)
    ending = made.run()
    if keeps_log:
        ending.log = [in_words(*each) for each in made.simulation.log]
    return ending


def spread(count: int, kinds: Sequence[str]) -> Iterator[tuple[str, int]]:
    """So many histories over the kinds, as their weights have it; the first ones are the same whatever the count."""
    names = [name for name in kinds for _ in range(max(KINDS[name].weight, 1 if len(kinds) < len(KINDS) else 0))]
    step = next(n for n in (37, 41, 43, 47, 53) if len(names) % n)
    order = [names[(at * step) % len(names)] for at in range(len(names))]
    for seed in range(count):
        kind = order[seed % len(order)]
        if kind == "trial" and len(kinds) == len(KINDS) and (seed // len(order)) % 4 == 0:
            kind = "five_stage"
        if kind == "decisions" and len(kinds) == len(KINDS) and (seed // len(order)) % 2 == 0:
            kind = "watched"
        yield kind, seed
