"""A test by pulses of the set-point on a bus in memory: who else moves the set-point, what a kill leaves, MV at its
limit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar
from unittest.mock import patch

import pytest

from loopwright.protocol.profile import COMMAND_FRAME, channel_ids
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import RunResult, run
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.experiments.primitives import Directions, Facts
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.evaluation.proposal import FastProposal
from loopwright.tuning.fast.pulses.procedure import setpoint
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from loopwright.tuning.plan import Command, Event, Sample, StageStarted
from loopwright.tuning.reasons import Reason
from tests.unit.service.bus_site import FOUND, Killed, Site

PLANT = FOPDT(K=0.01, T=10.0, L=2.0)
"""The plant of the site, in PV units per percent."""
T95_S, STEP = 32.0, 0.1
OVER_S = 1.7
"""A session whose tuner is silent is over then: it watches for 1.5 s."""
Strike = Callable[[str, int], None]
"""Called after each sample, with its stage and the number of samples in that stage."""


def of_a_test(
    site: Site,
    strike: Strike = lambda stage, samples: None,
    mv: tuple[float, float] = (0.0, 100.0),
    **more: Any,
) -> tuple[RunResult[FastProposal], list[Sample]]:
    """A whole test with these MV limits of the job, percent, and further facts of the loop, and its samples."""
    if site.plant.pace:
        site.let_run()
    state = site.loop.read()
    facts = Facts(site.plant.sample_time_s, T95_S, *mv, STEP, state.gains, **more)
    taken: list[Sample] = []
    stage, since = "", 0

    def hear(event: Event) -> None:
        nonlocal stage, since
        if isinstance(event, StageStarted):
            stage, since = event.stage, 0

    def step(commands: Sequence[Command]) -> Sample:
        nonlocal since
        sample = one_step(commands)
        since += 1
        strike(stage, since)
        return sample

    one_step = site.loop.step
    with patch.object(site.loop, "step", step):
        found = run(
            setpoint(facts, DesignOptions(propose_anyway=True)), site.loop, limits=RunLimits(49.0, 51.0, *mv),
            on_event=hear, on_samples=taken.extend,
        )  # fmt: skip
    return found, taken


class TestWhoseSetpoint:
    def test_one_that_moves_at_most_samples_is_not_pulsed(self) -> None:
        """A ramp or an outer loop within the device: no hand from outside that would end the session."""
        site = Site(pace=0.0)

        def ramp(stage: str, samples: int) -> None:
            site.channel.setpoint += 1e-4

        found, taken = of_a_test(site, ramp)
        assert found.ended is not None and found.ended.reason is Reason.SETPOINT_IS_DRIVEN
        assert "10 of 10 parts of the time" in found.ended.detail
        assert len(taken) < 1.1 * T95_S / 2 / 0.1, "it is refused at once, not after four looks"
        assert not site.controller.sessions[0].is_open

    def test_an_outer_loop_that_wakes_in_mid_pulse_has_the_last_word(self) -> None:
        site = Site()

        def outer(stage: str, samples: int) -> None:
            if stage == "pulses" and samples in (10, 20):
                site.replay((channel_ids(1).command, COMMAND_FRAME.pack(50.0 if samples == 10 else 50.02)))

        found, _ = of_a_test(site, outer)
        assert found.ended is not None and found.ended.reason is Reason.SETPOINT_CHANGED
        assert site.is_home(setpoint=pytest.approx(50.02))


@pytest.mark.parametrize(
    ("stage", "samples"),
    [("preflight", 30), ("pulses", 2), ("pulses", 15), ("pulses", 60), ("design", 1), ("verify", 2), ("verify", 40)],
)
def test_a_kill_leaves_the_loop_at_home(stage: str, samples: int) -> None:
    site = Site()
    modes: set[int] = set()
    moved = False

    def kill(now: str, passed: int) -> None:
        nonlocal moved
        modes.add(site.channel.mode)
        if (now, passed) == (stage, samples):
            moved = site.channel.setpoint != 50.0 or site.channel.on_trial
            site.gateway.dead = True

    with pytest.raises(Killed):
        of_a_test(site, kill)
    assert moved == (stage != "preflight") and site.controller.sessions[0].is_open
    assert site.mv != 50.0 or not moved
    site.pass_time(OVER_S)
    assert site.is_home()
    assert modes == {2}, "automatic, all the time"


class TestMvAtItsLimit:
    LOW, HIGH = 40.0, 60.0

    def with_limits_in_the_device(self, gains: Gains) -> Site:
        site = Site(pace=0.0)
        site.hand("controller_mv_low", self.LOW)
        site.hand("controller_mv_high", self.HIGH)
        site.channel.accept(gains)
        return site

    def test_present_gains_that_overshoot_get_pulses_that_keep_MV_off_its_limits(self) -> None:
        """The swing of a full pulse would take MV to both."""
        site = self.with_limits_in_the_device(replace(FOUND, Kp=500.0, Ti=5.0))
        found, taken = of_a_test(site, mv=(self.LOW, self.HIGH))
        assert not {self.LOW, self.HIGH} & {sample.mv for sample in taken}
        assert found.value is not None, found.ended
        assert margins(PLANT, found.value.gains).Ms == pytest.approx(1.6, abs=0.05)
        assert site.is_home()

    def test_a_lasting_load_that_holds_MV_there_ends_the_test_soon_and_says_so(self) -> None:
        site = self.with_limits_in_the_device(FOUND)
        seen = 0

        def load(stage: str, samples: int) -> None:
            nonlocal seen
            if stage == "pulses":
                seen = samples
                if samples == 15:
                    site.plant.plants[0].disturbance = -12.0

        found, taken = of_a_test(site, load, (self.LOW, self.HIGH))
        assert found.ended is not None and found.ended.reason is Reason.MV_LIMIT
        assert "MV has stood at its limit of 60 for" in found.ended.detail
        held = [sample.mv for sample in taken].count(self.HIGH) * site.plant.sample_time_s
        assert held < T95_S, "a test that only waits for the end of its longest record takes tens of T95"
        assert site.is_home()

    def test_of_the_job_alone_the_test_ends_safe(self) -> None:
        site = Site(pace=0.0)

        def load(stage: str, samples: int) -> None:
            if stage == "pulses" and samples == 15:
                site.plant.plants[0].disturbance = -12.0

        found, _ = of_a_test(site, load, (self.LOW, self.HIGH))
        assert found.ended is not None and found.ended.reason is Reason.MV_LIMIT
        assert site.is_home()


class TestDownByRamps:
    """A loop whose set-point may only go down, by a permitted step in 4 s: half an ultimate period."""

    RATE = STEP / 4.0
    LIMITS: ClassVar[dict[str, Any]] = {"directions": Directions.DOWN, "sp_rate_max_per_s": RATE}

    def test_the_controller_never_gets_another_set_point(self) -> None:
        site = Site()
        held: list[float] = []
        found, taken = of_a_test(site, lambda stage, samples: held.append(site.channel.setpoint), **self.LIMITS)
        assert found.value is not None, found.ended
        assert margins(PLANT, found.value.gains).Ms == pytest.approx(1.6, abs=0.05)
        assert max(held) == 50.0 > min(held) >= 50.0 - STEP - 1e-5
        allowed = self.RATE * site.plant.sample_time_s + 1e-5  # REAL32
        assert max(abs(after - before) for before, after in pairwise(held)) <= allowed
        assert {sample.mode for sample in taken} == {2} and site.is_home()

    @pytest.mark.parametrize(("stage", "samples"), [("pulses", 15), ("verify", 10)])
    def test_a_kill_on_a_ramp_leaves_the_loop_at_home(self, stage: str, samples: int) -> None:
        site = Site()
        at = 50.0

        def kill(now: str, passed: int) -> None:
            nonlocal at
            if (now, passed) == (stage, samples):
                at = site.channel.setpoint
                site.gateway.dead = True

        with pytest.raises(Killed):
            of_a_test(site, kill, **self.LIMITS)
        assert 50.0 - STEP < at < 50.0, "on its way"
        site.pass_time(OVER_S)
        assert site.is_home()

    @pytest.mark.parametrize(("stage", "samples"), [("pulses", 15), ("verify", 10)])
    def test_a_bus_that_is_lost_on_a_ramp_leaves_the_loop_at_home(self, stage: str, samples: int) -> None:
        """The service can do nothing; the controller misses its heartbeat."""
        site = Site()
        at = 50.0

        def cut(now: str, passed: int) -> None:
            nonlocal at
            if (now, passed) == (stage, samples):
                at = site.channel.setpoint
                site.lost = OSError(100, "Network is down")

        found, _ = of_a_test(site, cut, **self.LIMITS)
        assert found.ended is not None and found.ended.reason is Reason.BUS_LOST
        assert 50.0 - STEP < at < 50.0, "on its way"
        site.pass_time(OVER_S)
        assert site.is_home()

    def test_an_operator_who_moves_the_set_point_on_a_ramp_has_the_last_word(self) -> None:
        site = Site()

        def outer(stage: str, samples: int) -> None:
            if stage == "pulses" and samples == 15:
                site.hand("controller_setpoint", 50.03)

        found, _ = of_a_test(site, outer, **self.LIMITS)
        assert found.ended is not None and found.ended.reason is Reason.SETPOINT_CHANGED
        assert site.is_home(setpoint=pytest.approx(50.03))
