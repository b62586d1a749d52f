"""Controllers that do not do what their gains say: what is proposed, what Ms that gives, and what the check names.

    python -m benchmarks.controllers [--method fast|setpoint] [--unchecked] [--kinds "Kp x 1.4;..."] [--seeds N]

Three plants: a lag with a dead time of 0.3 and of 1 lags, and two lags. Noise of 1 % of the permitted step of the
set-point; present gains of Kp = 0.25 Ku and Ti = Pu, a PID's Td an eighth of Pu; Ms 1.6 is asked for. Ms is that of the
gains proposed under the controller's own law on the true plant.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np

from benchmarks.cases import ASKED
from benchmarks.command import check_names, parser_of
from benchmarks.other_controllers import PI, PID, OtherChannel
from benchmarks.plants import Plant, plant_of
from loopwright.controller.channel import Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import run
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.pulses.procedure import SETPOINT, setpoint
from loopwright.tuning.fast.relay.procedure import FAST, FastOptions, fast
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode

STEP, NOISE, T95_PERIODS = 1.0, 0.01, 3.0
KINDS = PI | PID
PLANTS = (
    plant_of("lag, dead time 0.3", TransferFunction((2.0,), (1.0, 1.0), 0.3)),
    plant_of("lag, dead time 1", TransferFunction((0.5,), (1.0, 1.0), 1.0)),
    plant_of("two lags", TransferFunction((1.0,), (1.0, 2.0, 1.0), 0.3)),
)


@dataclass(frozen=True, slots=True)
class Controlled:
    """How one run ended. Ms: of what was proposed, on the true plant under the true law; None where unstable.

    reason, detail: why nothing was proposed, None if something was. notes: of the proposal.
    """

    kind: str
    method: str
    plant: str
    seed: int
    reason: str | None = None
    detail: str = ""
    Ms: float | None = None
    notes: tuple[str, ...] = ()


def measure(plant: Plant, kind: str, seed: int, method: str, checked: bool = True) -> Controlled:
    other = KINDS[kind]
    gains = Gains(0.25 * plant.Ku, plant.Pu)
    if other.derivative:
        gains = replace(gains, Td=plant.Pu / 8.0, Tf=plant.Pu / 80.0)
    if other.steps:
        other = replace(other, steps=other.steps * gains.Kp * STEP)
    model = plant.model()
    limit = 20.0 * max(1.0 / abs(model.static_gain), gains.Kp) * STEP
    settings = Settings(mv_low=-limit, mv_high=limit, pv_low=-1e9, pv_high=1e9, reverse=True)
    said = Parameters(gains.Kp, gains.Ti, gains.Td, gains.Tf)
    channel = OtherChannel(other, plant.Pu, plant.Ts, settings, said, 0.0, int(Mode.AUTOMATIC))
    process = LinearPlant(plant.num, plant.den, plant.L, plant.Ts, noise_std=NOISE * STEP, seed=seed)
    loop = RehearsedLoop(process, channel, plant.Ts)
    facts = Facts(plant.Ts, T95_PERIODS * plant.Pu, -limit, limit, STEP, gains, True)
    kinds = FastOptions if method == FAST else DesignOptions
    options = kinds(ASKED, other.derivative, propose_anyway=True)
    plan = fast(facts, options) if isinstance(options, FastOptions) else setpoint(facts, options)
    with ExitStack() as patched:
        if not checked:
            effect = "loopwright.tuning.fast.evaluation.controller_effect"
            patched.enter_context(patch(f"{effect}.mismatch", lambda evaluation: None))
            patched.enter_context(patch("loopwright.tuning.experiments.preflight.check_law_at_rest", lambda *_: None))
        ran = run(plan, loop, limits=RunLimits(max_time_s=100.0 * plant.Pu))
    found = Controlled(kind, method, plant.name, seed)
    if ran.value is None:
        assert ran.ended is not None
        return replace(found, reason=ran.ended.reason.value, detail=ran.ended.detail)
    proposed = other.isa(ran.value.gains)
    if proposed.Td > 0.0 and not proposed.Tf > 0.0:
        proposed = replace(proposed, Tf=1e-6 * proposed.Td)
    den = np.convolve(plant.den, (other.filter * plant.Pu, 1.0)) if other.filter else plant.den
    true = margins(TransferFunction(plant.num, tuple(map(float, den)), model.L + other.late * plant.Ts), proposed)
    return replace(found, Ms=true.Ms if true.stable else None, notes=ran.value.notes)


def line(kind: str, method: str, runs: list[Controlled]) -> str:
    """One row of the table in Markdown."""
    proposed = [each for each in runs if each.reason is None]
    stable = [each.Ms for each in proposed if each.Ms is not None]
    unstable = " and unstable" if len(stable) < len(proposed) else ""
    shown = f"{min(stable):.2f}..{max(stable):.2f}{unstable}" if stable else unstable[5:] or "-"
    reasons = Counter(each.reason for each in runs if each.reason).most_common()
    return (
        f"| {kind} | {method} | {len(proposed)}/{len(runs)} | {shown} | "
        f"{', '.join(f'{reason} {count}' for reason, count in reasons) or '-'} |"
    )


def table(kinds: list[str], methods: list[str], seeds: int, checked: bool) -> Iterator[str]:
    yield "| the controller | procedure | proposed | true Ms | refused |"
    yield "| --- | --- | --- | --- | --- |"
    for kind in kinds:
        for method in methods:
            runs = [measure(plant, kind, seed + 1, method, checked) for plant in PLANTS for seed in range(seeds)]
            yield line(kind, method, runs)
            for each in runs:
                for text in (each.detail, *each.notes):
                    if text:
                        yield f"    {each.plant}, seed {each.seed}: {text}"


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--method", choices=(FAST, SETPOINT), help="default: both")
    parser.add_argument("--kinds", default=";".join(KINDS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--unchecked", action="store_true", help="without the controller check, as it was before it")
    given = parser.parse_args()
    kinds = given.kinds.split(";")
    check_names(parser, "kind", kinds, KINDS)
    methods = [given.method] if given.method else [FAST, SETPOINT]
    for text in table(kinds, methods, given.seeds, not given.unchecked):
        print(text, flush=True)


if __name__ == "__main__":
    main()
