"""A test by pulses of the manual output on a bus in memory: whatever ends it, MV is back at the manual output found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import patch

import pytest

from loopwright.controller.channel import Mode
from loopwright.protocol.bus import BusError
from loopwright.protocol.objects import lookup
from loopwright.protocol.profile import Cause, Order
from loopwright.protocol.session import STAGED, object_of
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import RunResult, run
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.proposal import FastProposal
from loopwright.tuning.fast.manual.procedure import by_manual
from loopwright.tuning.models import FOPDT
from loopwright.tuning.plan import Command, Event, Sample, StageStarted
from loopwright.tuning.reasons import Reason
from tests.unit.service.bus_site import NEW, Killed, Site

PLANT = FOPDT(K=0.01, T=10.0, L=2.0)
"""The plant of the site, in PV units per percent."""
T95_S, STEP = 32.0, 0.1
PV_LOW, PV_HIGH = 49.5, 50.5
HOME = 50.0
OVER_S = 1.7
"""A session whose tuner is silent is over then: it watches for 1.5 s."""
Strike = Callable[[str, float], None]
"""Called after each sample, with its stage and by how much MV is away."""


def in_manual(pace: float = 1.0) -> Site:
    """A loop in manual, at rest."""
    return Site(pace, mode=Mode.MANUAL)


def of_a_test(
    site: Site,
    strike: Strike = lambda stage, away: None,
    stop: Callable[[], Reason | None] = lambda: None,
    **more: Any,
) -> tuple[RunResult[FastProposal], list[Sample]]:
    """A whole test with further facts of the loop, and its samples."""
    if site.plant.pace:
        site.let_run()
    state = site.loop.read()
    given: dict[str, Any] = {
        "sample_time_s": site.plant.sample_time_s, "T95_s": T95_S, "mv_low": 0.0, "mv_high": 100.0,
        "sp_deviation": STEP, "previous_gains": state.gains, "pv_low": PV_LOW, "pv_high": PV_HIGH,
    }  # fmt: skip
    facts = Facts(**given | more)
    taken: list[Sample] = []
    stage = ""

    def hear(event: Event) -> None:
        nonlocal stage
        if isinstance(event, StageStarted):
            stage = event.stage

    def step(commands: Sequence[Command]) -> Sample:
        sample = one_step(commands)
        strike(stage, sample.mv - HOME)
        return sample

    one_step = site.loop.step
    with patch.object(site.loop, "step", step):
        plan = by_manual(facts, DesignOptions(propose_anyway=True), "fast")
        found = run(
            plan, site.loop, limits=RunLimits(PV_LOW - 1.0, PV_HIGH + 1.0, 0.0, 100.0), on_event=hear,
            on_samples=taken.extend, stop=stop,
        )  # fmt: skip
    return found, taken


def is_home(site: Site) -> bool:
    """Once the next sample has carried the manual output to the plant."""
    site.pass_time(0.3)
    return site.is_home(mode=Mode.MANUAL) and (site.channel.manual_output, site.mv) == (HOME, HOME)


def test_it_gets_the_Ms_asked_and_ends_at_home() -> None:
    site = in_manual(pace=0.0)
    found, taken = of_a_test(site)
    assert found.value is not None, found.ended
    assert margins(PLANT, found.value.gains).Ms == pytest.approx(1.6, abs=0.05)
    assert {sample.mode for sample in taken} == {Mode.MANUAL}
    assert taken[-1].mv == HOME and site.is_home(mode=Mode.MANUAL)


def test_new_gains_take_effect_in_manual_without_moving_MV() -> None:
    site = in_manual()
    site.let_run()
    before = site.loop.read().gains
    site.loop.accept(NEW, before)
    assert is_home(site)
    assert (site.channel.accepted.Kp, site.channel.accepted.Ti) == (NEW.Kp, NEW.Ti)


@pytest.mark.parametrize("pulse", [1, 2])
def test_a_kill_in_a_pulse_leaves_the_loop_at_home(pulse: int) -> None:
    site = in_manual()
    moves = 0
    was_away = False

    def kill(stage: str, away: float) -> None:
        nonlocal moves, was_away
        moves += bool(away) and not was_away
        was_away = bool(away)
        if moves == pulse and away:
            site.gateway.dead = True

    with pytest.raises(Killed):
        of_a_test(site, kill)
    assert site.mv != HOME and site.controller.sessions[0].is_open
    site.pass_time(OVER_S)
    assert site.controller.sessions[0].cause is Cause.HEARTBEAT
    assert is_home(site)


def test_a_bus_that_is_lost_in_a_pulse_leaves_the_loop_at_home() -> None:
    site = in_manual()

    def cut(stage: str, away: float) -> None:
        if away:
            site.lost = BusError("the interface is down")

    found, _ = of_a_test(site, cut)
    assert found.ended is not None and found.ended.reason in (Reason.BUS_LOST, Reason.RESTORE_UNCONFIRMED)
    site.lost = None
    site.pass_time(OVER_S)
    assert is_home(site)


def test_an_abort_in_a_pulse_leaves_the_loop_at_home() -> None:
    site = in_manual()
    asked: list[Reason] = []

    def ask(stage: str, away: float) -> None:
        if away:
            asked.append(Reason.OPERATOR)

    found, _ = of_a_test(site, ask, lambda: asked[0] if asked else None)
    assert found.ended is not None and found.ended.reason is Reason.OPERATOR
    assert is_home(site)


def test_a_defect_in_a_pulse_leaves_the_loop_at_home() -> None:
    site = in_manual()

    def fail(stage: str, away: float) -> None:
        if away:
            raise ZeroDivisionError

    found, _ = of_a_test(site, fail)
    assert found.ended is not None and found.ended.reason is Reason.INTERNAL
    assert is_home(site)


def test_the_controller_itself_ends_the_test_where_pv_leaves_the_limits_of_the_job() -> None:
    """The runner's own limits are far off here."""
    site = in_manual(pace=0.0)

    def load(stage: str, away: float) -> None:
        if away:
            site.plant.plants[0].disturbance = 80.0

    found, taken = of_a_test(site, load)
    assert found.ended is not None and found.ended.reason is Reason.PV_LIMIT
    assert "the controller ended the test" in found.ended.detail
    assert site.controller.sessions[0].cause is Cause.PV_LIMIT
    assert max(sample.pv for sample in taken) < PV_HIGH + 0.2
    assert is_home(site)


def test_a_transmitter_that_breaks_in_a_pulse_leaves_the_loop_at_home() -> None:
    site = in_manual()

    def break_it(stage: str, away: float) -> None:
        if away:
            site.transmitter(False)

    found, _ = of_a_test(site, break_it)
    assert found.ended is not None and found.ended.reason is Reason.BAD_SAMPLE
    site.pass_time(OVER_S)
    assert is_home(site)


def test_MV_at_its_limit_is_refused_before_anything_moves() -> None:
    site = in_manual(pace=0.0)
    site.hand("controller_mv_high", 51.0)
    found, taken = of_a_test(site, mv_high=51.0)
    assert found.ended is not None and found.ended.reason is Reason.SATURATED
    assert {sample.mv for sample in taken} == {HOME}
    assert is_home(site)


@pytest.mark.parametrize("known", [(), STAGED[Order.WATCH]], ids=["nothing", "values"])
def test_a_controller_without_the_order_WATCH_is_refused_before_anything_moves(known: tuple[str, ...]) -> None:
    """One of an older version, and one that knows the values of the order."""
    site = in_manual(pace=0.0)
    for name in {object_of(Order.WATCH), *STAGED[Order.WATCH]} - set(known):
        del site.controller.dictionary.by_index[lookup(name).index]
    found, taken = of_a_test(site)
    assert found.ended is not None and found.ended.reason is Reason.DEVICE_MISMATCH
    assert "20h (32) does not know the order WATCH (object 2178h)" in found.ended.detail
    assert {sample.mv for sample in taken} == {HOME}
    assert "controller_order_output" not in site.names()
    assert is_home(site)


def test_a_limit_of_MV_that_an_operator_moves_in_a_pulse_has_the_last_word() -> None:
    site = in_manual()

    def narrow(stage: str, away: float) -> None:
        if away:
            site.hand("controller_mv_high", 60.0)

    found, _ = of_a_test(site, narrow)
    assert found.ended is not None and found.ended.reason is Reason.LIMITS_CHANGED
    assert is_home(site)
