"""A loop that a cut-off test has left swinging: given time, the next attempt finds it at rest."""

from __future__ import annotations

import pytest

from benchmarks.rehearsed import entry, open_loop
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.procedures import plan
from loopwright.service.execution.runner import RunResult, run
from loopwright.service.inputs.config import parse_site
from loopwright.service.inputs.request import retune_request
from loopwright.service.loops.loop import Loop
from loopwright.service.store.jobs import JobEvent
from loopwright.tuning.experiments.preflight import SETTLE
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.settle import MAX_ATTEMPTS
from loopwright.tuning.plan import Event, Mode, Plan, SetMode, SetOutput, StageStarted
from loopwright.tuning.reasons import Reason

TAG = "TIC-1"
CONFIG = parse_site({"loops": [entry(TAG)]}, "test").loops[TAG]
CUT_OFF = [JobEvent(job_id="cut", seq=1, at="", plant_time_s=0.0, kind="loop_found", data={})]


def _pushed(facts: Facts, working_output: float) -> Plan[None]:
    """What a test does to a loop before it is cut off."""
    commands = (SetMode(Mode.MANUAL), SetOutput(working_output + 10.0))
    for n in range(round(facts.T95_s / facts.sample_time_s)):
        yield commands if n == 0 else ()


@pytest.fixture
def swinging() -> tuple[Loop, Facts]:
    loop = open_loop(CONFIG)
    state = loop.read()
    facts = Facts(
        state.sample_time_s, CONFIG.t95_s, state.mv_low, state.mv_high, CONFIG.sp_deviation, state.gains,
        state.reverse_acting,
    )  # fmt: skip
    run(_pushed(facts, state.mv), loop, limits=RunLimits())
    return loop, facts


def _attempt(loop: Loop, facts: Facts, earlier: list[JobEvent], method: str) -> tuple[RunResult[object], list[str]]:
    stages: list[str] = []

    def hear(event: Event) -> None:
        if isinstance(event, StageStarted):
            stages.append(event.stage)

    return (
        run(plan(CONFIG, retune_request(method=method), facts, earlier), loop, limits=RunLimits(), on_event=hear),
        stages,
    )


@pytest.mark.parametrize("method", ["fast", "five-stage"])
def test_a_second_attempt_gives_the_loop_time_to_come_to_rest(swinging: tuple[Loop, Facts], method: str) -> None:
    loop, facts = swinging
    ran, stages = _attempt(loop, facts, CUT_OFF, method)
    assert ran.value is not None, ran.ended
    assert stages[:2] == [SETTLE, "preflight"]
    assert facts.T95_s < ran.plant_time_s[SETTLE] < MAX_ATTEMPTS / 2 * facts.T95_s


def test_a_first_attempt_is_refused_there(swinging: tuple[Loop, Facts]) -> None:
    ran, stages = _attempt(*swinging, [], "fast")
    assert ran.ended is not None and ran.ended.reason is Reason.NOT_AT_REST
    assert stages == ["preflight", *(3 * [SETTLE, "preflight"])]
