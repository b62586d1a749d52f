"""A rehearsal of fast that is refused, for each reason that can be provoked, with the picture of its job.

python -m benchmarks.refusals docs/refusals
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.command import check_names, parser_of
from benchmarks.other_controllers import Other, OtherChannel
from loopwright.controller.channel import Channel, Settings
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.cli.plots.fast_job import fast_job
from loopwright.service.cli.rehearsed import RehearsedJob, shown_samples
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop, _parameters
from loopwright.service.execution.rehearsed import RehearsalRecord
from loopwright.service.execution.result import result_of
from loopwright.service.execution.runner import run
from loopwright.service.jobs.stored_record import stored_record
from loopwright.service.jsonable import to_jsonable
from loopwright.service.results import EvidenceView, GainsView
from loopwright.service.states.job_state import JobState
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.evaluation.proposal import EvaluationSummary
from loopwright.tuning.fast.excitation_choice import fast_by
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.procedure import FastOptions
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Event, Mode, StageDone, StageStarted

TS, T95, MIDDLE, SP = 0.1, 26.0, 50.0, 20.0
OLD = Gains(1.0, 10.0)
PERIOD_S = 7.4
"""The ultimate period of the plant."""
COLOURS = 48
"""Of a picture that goes into the documents: a third of the bytes."""
Change = Callable[[float, float], float]
"""A signal and the time in s since the stage began that the change is of."""


def _same(value: float, t: float) -> float:
    return value


@dataclass
class Case:
    """why: what is wrong with the plant, in words. of: the stage from which on it is. excitation: with pulses of the
    manual output the loop is in manual. other: what the controller does in place of what its gains say."""

    why: str
    mv: Change = _same
    pv: Change = _same
    of: str = "relay"
    options: dict[str, Any] = field(default_factory=dict)
    num: tuple[float, ...] = (0.5,)
    den: tuple[float, ...] = (8.0, 1.0)
    dead_time_s: float = 2.0
    noise: float = 0.02
    reverse: bool = True
    gains: Gains = OLD
    seed: int = 1
    excitation: Excitation = Excitation.RELAY
    other: Other | None = None


class Odd:
    """A linear plant around an operating point, whose input and output are tampered with from a stage on."""

    def __init__(self, case: Case) -> None:
        self._case = case
        self._plant = LinearPlant(
            list(case.num), list(case.den), case.dead_time_s, TS, noise_std=case.noise, seed=case.seed
        )
        self.t: float | None = None

    @property
    def pv(self) -> float:
        return SP + self._plant.pv

    def step(self, mv: float) -> float:
        case, t = self._case, self.t
        if t is None:
            return SP + self._plant.step(mv - MIDDLE)
        self.t = t + TS
        return SP + case.pv(self._plant.step(case.mv(mv - MIDDLE, t)), t)


class Sticking:
    """A valve that moves only when it is pushed by more than its stiction."""

    def __init__(self, stiction: float) -> None:
        self._stiction, self._at = stiction, 0.0

    def __call__(self, mv: float, t: float) -> float:
        if abs(mv - self._at) > self._stiction:
            self._at = mv - math.copysign(0.5 * self._stiction, mv - self._at)
        return self._at


def _load(size: float, at: float) -> Change:
    return lambda mv, t: mv + (size if t >= at else 0.0)


def cases() -> dict[str, Case]:
    """By the reason that each is meant to end with."""
    return {
        "no_response": Case("the valve is shut: MV reaches nothing", mv=lambda mv, t: 0.0),
        "wrong_sign": Case(
            "the controller is set to direct action on a plant of positive gain", reverse=False, gains=Gains(1e-6, 0.0)
        ),
        "cannot_oscillate": Case(
            "T95 is stated as 26 s; the lag is 240 s", num=(1.0,), den=(240.0, 1.0), dead_time_s=20.0
        ),
        "stalled": Case("a load of twice the relay comes in its second period", mv=_load(60.0, 12.0)),
        "unexplained": Case("the valve sticks: it moves only when pushed by 12 %", mv=Sticking(12.0)),
        "disturbed": Case(
            "another loop swings, and moves PV by a little more than its noise",
            pv=lambda pv, t: pv + 0.03 * math.sin(3.0 * t), noise=0.03,
        ),
        "uncertain": Case(
            "the relay is too small for the noise", options={"amplitude": 1.0, "verify": False}, noise=0.15
        ),
        "model_mismatch": Case(
            "the plant's gain doubles as the new gains are tried", mv=lambda mv, t: 2.0 * mv, of="verify", seed=5
        ),
        "controller_mismatch": Case(
            "the controller has a filter of PV of 1 s inside", other=Other(filter=1.0 / PERIOD_S)
        ),
        "diverges": Case("the sensor's range is switched as the new gains are tried", pv=lambda pv, t: 100.0 * pv,
                         of="verify"),
    }  # fmt: skip


def rehearsed(case: Case) -> tuple[RehearsedJob, RehearsalRecord]:
    """The job, as GET /jobs/{id} would show it, and its samples."""
    plant = Odd(case)
    settings = Settings(mv_low=0.0, mv_high=100.0, safe_output=MIDDLE, pv_low=-1e9, pv_high=1e9, reverse=case.reverse)
    mode = Mode.MANUAL if case.excitation is Excitation.MANUAL else Mode.AUTOMATIC
    start = (TS, settings, _parameters(case.gains), SP, int(mode), MIDDLE)
    channel = Channel(*start) if case.other is None else OtherChannel(case.other, PERIOD_S, *start)
    loop = RehearsedLoop(plant, channel, TS)
    samples = RehearsalRecord()
    found: EvidenceView | None = None

    def hear(event: Event) -> None:
        nonlocal found
        samples.on_event(event)
        if isinstance(event, StageStarted) and event.stage == case.of:
            plant.t = 0.0
        elif isinstance(event, StageDone) and isinstance(event.result, EvaluationSummary):
            found = EvidenceView.model_validate(to_jsonable(event.result))

    facts = Facts(TS, T95, 0.0, 100.0, 2.0, case.gains, case.reverse)
    plan = fast_by((case.excitation,), facts, FastOptions(**case.options, propose_anyway=True))
    ran = run(plan, loop, limits=RunLimits(), on_event=hear, on_samples=samples.on_samples)
    ended = ran.ended
    result = None if ran.value is None else result_of(ran.value)
    job = RehearsedJob(
        loop=case.why,
        method="fast",
        state=JobState.PROPOSED if ran.value else JobState.REFUSED,
        reason=ended.reason if ended else None,
        detail=ended.detail if ended else None,
        advice=ended.advice if ended else None,
        model=None if result is None else result.model,
        previous_gains=GainsView.of(case.gains),
        new_gains=None if result is None else result.new_gains,
        evidence=found,
        verification=None,
    )
    return job, samples


def draw(path: Path, job: RehearsedJob, samples: RehearsalRecord) -> None:
    record = stored_record(shown_samples(samples, None).columns())
    assert record is not None
    fast_job(path, job, record, "degC")
    Image.open(path).convert("RGB").quantize(COLOURS).save(path, optimize=True)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, help="where the pictures go")
    parser.add_argument("reasons", metavar="REASON", nargs="*", help=f"only of these; default: {', '.join(cases())}")
    given = parser.parse_args()
    folder, only = given.folder, given.reasons
    check_names(parser, "reason", only, cases())
    folder.mkdir(parents=True, exist_ok=True)
    for reason, case in cases().items():
        if only and reason not in only:
            continue
        path = folder / f"{reason.replace('_', '-')}.png"
        job, samples = rehearsed(case)
        draw(path, job, samples)
        print(f"{reason}: {job.state} {job.reason}: {job.detail} ({path.stat().st_size // 1000} kB)", flush=True)


if __name__ == "__main__":
    main()
