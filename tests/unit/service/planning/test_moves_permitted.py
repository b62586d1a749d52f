"""To which side and how fast a test may move the set-point: the file, the request, the preview and the refusals."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from pydantic import ValidationError

from loopwright.service.execution.procedures import Hooks, rehearse
from loopwright.service.inputs.config import LoopConfig, PermittedTest
from loopwright.service.inputs.request import BadLimits, excitations, retune_request, within
from loopwright.service.planning.facts import facts_of
from loopwright.service.planning.moves import broken_limits
from loopwright.service.planning.preview import Preview
from loopwright.tuning.experiments.primitives import Directions
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.plan import Sample
from tests.unit.service.fakes import loop_entry
from tests.unit.service.planning.test_preview import EITHER, STATE, told

UP = {"test": {"excitations": ["setpoint"], "directions": "up"}}
DOWN = {"test": {"excitations": ["setpoint"], "directions": "down"}}
SLOW = {"test": {"excitations": ["setpoint", "relay"], "sp_rate_max_per_s": 0.5}}
START_OF_TRIAL = {"start": "design", "model": {"K": 0.8, "T_s": 3.0, "L_s": 1.0}}


def loop(config: dict[str, Any]) -> LoopConfig:
    return LoopConfig.model_validate(loop_entry(**config))


def stages(found: Preview) -> dict[str, tuple[float | None, float | None]]:
    """The lowest and the highest set-point of each stage that moves it."""
    return {each.stage: (each.sp_low, each.sp_high) for each in found.stages if each.sp_move}


def of_limits(found: Preview) -> list[str]:
    return [each.detail for each in found.obstacles if each.reason == "bad_limits"]


class TestFile:
    @pytest.mark.parametrize(
        "given", [{"directions": "up"}, {"directions": "down", "excitations": ["observe", "relay"]}]
    )
    def test_one_direction_excludes_the_relay(self, given: dict[str, Any]) -> None:
        with pytest.raises(ValidationError) as caught:
            PermittedTest.model_validate(given)
        assert "exclude the relay, which moves PV to both sides: name excitations without it" in str(caught.value)

    @pytest.mark.parametrize("given", [{"directions": "left"}, {"sp_rate_max_per_s": 0.0}, {"sp_rate_max_per_s": -1}])
    def test_what_is_no_side_and_no_rate(self, given: dict[str, Any]) -> None:
        with pytest.raises(ValidationError):
            PermittedTest.model_validate(given)

    def test_a_loop_of_an_old_file_is_moved_as_before(self) -> None:
        facts = facts_of(loop({}), STATE)
        assert facts.directions is Directions.BOTH and facts.ramp_s(5.0) == 0.0


class TestRequest:
    @pytest.mark.parametrize("method", ["fast", "setpoint"])
    def test_it_may_narrow(self, method: str) -> None:
        found = within(loop(EITHER), retune_request(method=method, directions="down", sp_rate_max_per_s=0.2))
        facts = facts_of(found, STATE)
        assert (facts.directions, facts.sp_rate_max_per_s) == (Directions.DOWN, 0.2)
        assert facts.ramp_s(2.0) == pytest.approx(10.0)

    @pytest.mark.parametrize(
        ("config", "options", "words"),
        [
            (UP, {"directions": "both"}, "directions both is asked for, loops.yaml permits up"),
            (UP, {"directions": "down"}, "directions down is asked for, loops.yaml permits up"),
            (SLOW, {"sp_rate_max_per_s": 0.6}, "sp_rate_max_per_s 0.6 is more than the configured 0.5"),
        ],
    )
    @pytest.mark.parametrize("method", ["fast", "setpoint", "five-stage"])
    def test_it_cannot_widen(self, method: str, config: dict[str, Any], options: dict[str, Any], words: str) -> None:
        with pytest.raises(BadLimits, match=words):
            within(loop(config), retune_request(method=method, **options))

    def test_the_relay_is_left_out_where_one_direction_is_asked_for(self) -> None:
        request = retune_request(directions="up")
        assert excitations(within(loop(EITHER), request), request) == (Excitation.SETPOINT,)

    @pytest.mark.parametrize(
        ("config", "options", "words"),
        [
            (
                EITHER,
                {"excitations": ["relay"]},
                "a relay moves PV to both sides of its rest; ask for excitations without",
            ),
            ({}, {}, "a relay moves PV to both sides of its rest, and loops.yaml permits no other excitation"),
            ({}, {"method": "five-stage"}, "to both sides of its rest by relay and ultimate"),
            ({}, {"method": "simc"}, "to both sides of its rest by relay and ultimate"),
        ],
    )
    def test_the_relay_is_refused_under_one_direction(
        self, config: dict[str, Any], options: dict[str, Any], words: str
    ) -> None:
        found = told(config=config, directions="up", **options)
        assert not found.would_start and any(words in text for text in of_limits(found))

    @pytest.mark.parametrize(
        "options",
        [{"method": "five-stage"}, {"method": "simc", "start": "zn_pi", "Ku": 2.0, "Pu_s": 3.0}, START_OF_TRIAL],
    )
    def test_steps_that_are_measured_are_no_ramps(self, options: dict[str, Any]) -> None:
        found = told(config=SLOW, **options)
        assert any("settling of a step, which a ramp does not show" in text for text in of_limits(found))

    @pytest.mark.parametrize(
        "options",
        [{"method": "simc", "start": "zn_pi", "Ku": 2.0, "Pu_s": 3.0}, START_OF_TRIAL, {"method": "setpoint"}],
    )
    def test_what_steps_up_alone_is_kept_under_up(self, options: dict[str, Any]) -> None:
        found = told(config=UP, **options)
        assert of_limits(found) == []
        assert set(stages(found).values()) <= {(50.0, 52.0)}


class TestPreview:
    def test_it_says_the_side(self) -> None:
        up, down = told(config=UP), told(config=DOWN)
        assert stages(up) == {"pulses": (50.0, 52.0), "verify": (50.0, 52.0)}
        assert stages(down) == {"pulses": (48.0, 50.0), "verify": (48.0, 50.0)}
        assert down.largest_sp_move == 2.0
        pulses = next(each.what for each in down.stages if each.stage == "pulses")
        assert "down, back and down again" in pulses and "differs above and below where it begins is not seen" in pulses

    def test_a_trial_from_operation_or_for_a_model_goes_to_that_side(self) -> None:
        known = {"test": {"excitations": ["observe"], "directions": "down"}}
        assert stages(told(config=known)) == {"trial": (48.0, 50.0)}
        assert stages(told(config=DOWN, **START_OF_TRIAL)) == {"verify": (48.0, 50.0)}

    def test_only_the_side_that_is_used_needs_room(self) -> None:
        above, below = (
            {"pv_limits": {"low": low, "high": high}, "sp_deviation": 2.0} for low, high in ((49.0, 60.0), (40.0, 51.0))
        )
        request = retune_request(method="setpoint")
        for limits, way, broken in ((above, UP, 0), (above, DOWN, 1), (below, UP, 1), (below, DOWN, 0)):
            assert len(broken_limits(loop(limits | way), request, 50.0)) == broken

    @pytest.mark.parametrize("options", [{}, {"excitations": ["setpoint"]}, {"excitations": ["relay"]}])
    def test_it_says_how_long_the_ramps_take(self, options: dict[str, Any]) -> None:
        slow, free = told(config=SLOW, **options), told(config=EITHER, **options)
        verify = next(each for each in slow.stages if each.stage == "verify")
        assert "0.5 degC/s at most: 4 s for 2 degC" in verify.what
        moves = 2 if options == {"excitations": ["relay"]} else 7
        assert slow.duration_high_s == pytest.approx(free.duration_high_s + moves * 4.0)
        assert "returns at once, not by a ramp" in slow.on_abort and "by a ramp" not in free.on_abort

    def test_a_rate_at_which_pulses_tell_nothing_is_an_obstacle_with_numbers(self) -> None:
        found = told(config=SLOW, sp_rate_max_per_s=1e-4, excitations=["setpoint"])
        (text,) = (each.detail for each in found.obstacles if each.reason == "uncertain")
        assert "takes 2e+04 s for a move by 2" in text and "at least is needed" in text
        assert told(config=SLOW, sp_rate_max_per_s=1e-4, excitations=["relay"]).would_start, "the relay needs no ramp"

    def test_the_controller_of_another_state_is_no_matter(self) -> None:
        assert stages(told(replace(STATE, sp=30.0), config=UP | {"pv_limits": {"low": 0.0, "high": 100.0}})) == {
            "pulses": (30.0, 32.0),
            "verify": (30.0, 32.0),
        }


def test_a_dry_run_keeps_to_side_and_rate() -> None:
    taken: list[Sample] = []
    request = retune_request(
        method="setpoint", dry_run=True, directions="down", sp_rate_max_per_s=0.8, propose_anyway=True,
        plant={"num": [1.0], "den": [4.0, 1.0], "dead_time_s": 1.0, "noise_std": 0.01, "sample_time_s": 0.05},
    )  # fmt: skip
    config = within(loop({"t95_s": 13.0}), request)
    found = rehearse(config, request, Hooks(lambda event: None, taken.extend, lambda: None))
    assert found.ended is None, found.ended
    sp = [sample.sp for sample in taken]
    assert max(sp) == 0.0 > min(sp) >= -2.0
    assert max(abs(b - a) for a, b in pairwise(sp)) <= 0.8 * 0.05 * (1.0 + 1e-6)
