"""The controller check over the bus: our own device is never found to be another one, and another one is found."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import pytest

from loopwright.controller.pid import Parameters, Pid
from loopwright.protocol.bus import Frame
from loopwright.protocol.profile import channel_ids
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import RunResult, run
from loopwright.tuning.experiments import controller_check
from loopwright.tuning.experiments.control_record import ControlRecord
from loopwright.tuning.experiments.controller_check import ControllerCheck, check_controller
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.proposal import FastProposal
from loopwright.tuning.fast.pulses.procedure import setpoint
from loopwright.tuning.fast.relay.procedure import FastOptions, fast
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Plan
from loopwright.tuning.reasons import Reason
from tests.unit.service.bus_site import FOUND, Site, TunerBus

T95_S, STEP = 32.0, 0.1
NOISE = 0.001
USERS = ("loopwright.tuning.experiments.controller_mismatch", "loopwright.tuning.fast.evaluation.controller_effect")


@contextmanager
def heard() -> Iterator[list[ControllerCheck]]:
    """The checks that are made meanwhile."""
    found: list[ControllerCheck] = []

    def listen(record: ControlRecord) -> ControllerCheck:
        found.append(check_controller(record))
        return found[-1]

    with patch(f"{USERS[0]}.check_controller", listen), patch(f"{USERS[1]}.check_controller", listen):
        yield found


def by_pulses(facts: Facts) -> Plan[FastProposal]:
    return setpoint(facts, DesignOptions(propose_anyway=True))


def by_relay(facts: Facts) -> Plan[FastProposal]:
    return fast(facts, FastOptions(propose_anyway=True))


def run_on(
    site: Site, plan: Callable[[Facts], Plan[FastProposal]], noise: float = NOISE, **more: Any
) -> tuple[RunResult[FastProposal], list[ControllerCheck]]:
    """A whole test with the checks on its way."""
    site.plant.plants[0].noise_std = noise
    if site.plant.pace:
        site.let_run()
    state = site.loop.read()
    facts = Facts(site.plant.sample_time_s, T95_S, state.mv_low, state.mv_high, STEP, state.gains, **more)
    with heard() as checks:
        return run(plan(facts), site.loop, limits=RunLimits(49.0, 51.0, state.mv_low, state.mv_high)), checks


@pytest.mark.parametrize("plan", [by_pulses, by_relay])
@pytest.mark.parametrize("pace", [0.0, 1.0])
def test_our_own_device_does_what_its_gains_say(plan: Callable[[Facts], Plan[FastProposal]], pace: float) -> None:
    found, checks = run_on(Site(pace), plan)
    assert found.value is not None, found.ended
    assert len(checks) >= 3 and checks[-1].samples > 150
    assert all(check.roundings < 0.5 * controller_check.EXACT and check.other is None for check in checks)
    assert checks[-1].gain_error < 0.01 and checks[-1].integral_error < 0.03
    assert not any("controller" in note for note in found.value.notes)


def test_a_pid_with_limits_of_mv_and_of_its_rate_and_lost_frames_does_too() -> None:
    site = Site()
    for name, value in {"mv_low": 44.0, "mv_high": 56.0, "rate_limit": 15.0}.items():
        site.hand(f"controller_{name}", value)
    site.channel.accept(replace(FOUND, Td=0.5, Tf=0.05, b=0.7, c=0.3))
    recv, received = TunerBus.recv, 0

    def lossy(bus: TunerBus, timeout: float | None) -> Frame | None:
        """One MV in forty is lost on its way to this gateway."""
        nonlocal received
        frame = recv(bus, timeout)
        received += frame is not None and frame[0] == channel_ids(1).mv
        return frame if frame is None or frame[0] != channel_ids(1).mv or received % 40 else None

    with patch.object(TunerBus, "recv", lossy):
        _, checks = run_on(site, by_pulses)
    assert max(check.samples for check in checks) > 100
    assert all(check.exact and check.other is None for check in checks), checks


def test_a_test_by_ramps_does_too() -> None:
    found, checks = run_on(Site(), by_pulses, sp_rate_max_per_s=STEP / 4.0)
    assert found.value is not None, found.ended
    assert all(check.exact for check in checks)


class LouderPid(Pid):
    """One that takes Kp 1.4 times as large, and Ti with it."""

    def __init__(self, sample_time_s: float, parameters: Parameters, reverse: bool) -> None:
        super().__init__(sample_time_s, replace(parameters, Kp=1.4 * parameters.Kp), reverse)


class FilteringPid(Pid):
    """One that takes PV through a filter of 0.8 s: a tenth of the ultimate period."""

    _seen: float | None = None

    def step(self, setpoint: float, pv: float, low: float, high: float) -> float:
        self._seen = pv if self._seen is None else self._seen + (pv - self._seen) * 0.1 / 0.9
        return super().step(setpoint, self._seen, low, high)


@pytest.mark.parametrize(
    ("law", "what", "at_rest"),
    [(LouderPid, "Kp times 1.4 ", True), (FilteringPid, "a filter of PV inside the controller of 0.8 ", False)],
)
def test_another_controller_is_found(law: type[Pid], what: str, at_rest: bool) -> None:
    with patch("loopwright.controller.channel.Pid", law):
        site = Site()
        found, _ = run_on(site, by_pulses)
    assert found.ended is not None and found.ended.reason is Reason.CONTROLLER_MISMATCH
    assert what in found.ended.detail
    assert found.ended.detail.startswith("at rest") is at_rest
    assert site.is_home()


def test_gains_that_the_device_reports_wrong_are_found() -> None:
    """A device that answers with other gains than it has in effect."""
    site = Site()
    state = site.loop.read()
    wrong = Gains(state.gains.Kp / 2.0, state.gains.Ti)
    with patch.object(site.loop, "read", lambda beside_tests=False: replace(state, gains=wrong)):
        found, _ = run_on(site, by_pulses)
    assert found.ended is not None and found.ended.reason is Reason.CONTROLLER_MISMATCH
    assert "Kp times 2 " in found.ended.detail
