"""Pulses of the manual output: what the file and the request permit, the preview, the refusals, and the dry run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from loopwright.service.errors import RemoteSetpoint
from loopwright.service.execution.procedures import Hooks, plan, rehearse
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import (
    BadLimits,
    check_setpoint_source,
    excitations,
    retune_request,
    within,
    wrong_mode,
)
from loopwright.service.planning.facts import facts_of
from loopwright.service.planning.ground import Ground
from loopwright.service.planning.preview import Preview
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.plan import Mode, Sample
from tests.unit.service.fakes import loop_entry
from tests.unit.service.planning.test_preview import STATE, reasons, told

IN_MANUAL = replace(STATE, mode=Mode.MANUAL)
BOTH = {"test": {"excitations": ["setpoint", "manual"]}}
ALONE = {"test": {"excitations": ["manual"]}}
SETPOINT = {"test": {"excitations": ["setpoint"]}}


def loop(config: dict[str, Any]) -> LoopConfig:
    return LoopConfig.model_validate(loop_entry(**config))


def stage(found: Preview, name: str = "manual") -> Any:
    return next(each for each in found.stages if each.stage == name)


class TestChoice:
    def test_the_mode_decides(self) -> None:
        config, request = loop(BOTH), retune_request()
        assert excitations(config, request, Mode.MANUAL) == (Excitation.MANUAL,)
        assert excitations(config, request, Mode.AUTOMATIC) == (Excitation.SETPOINT,)

    def test_a_request_narrows_and_cannot_widen(self) -> None:
        narrowed = within(loop(BOTH), retune_request(excitations=["manual"]))
        assert narrowed.test.excitations == ("manual",)
        with pytest.raises(BadLimits, match=r"manual is asked for, loops.yaml permits setpoint"):
            within(loop(SETPOINT), retune_request(excitations=["manual"]))

    @pytest.mark.parametrize(
        "options", [{}, {"method": "setpoint"}, {"method": "five-stage"}, {"excitations": ["setpoint"]}]
    )
    def test_without_the_permission_a_loop_in_manual_is_refused_with_what_to_permit(
        self, options: dict[str, Any]
    ) -> None:
        config = SETPOINT if options.get("excitations") is None and "method" not in options else BOTH
        found = told(IN_MANUAL, config, **options)
        assert "wrong_mode" in reasons(found) and not found.would_start
        text = next(each.detail for each in found.obstacles if each.reason == "wrong_mode")
        assert "is in mode manual, not automatic" in text and "manual" in text and "loops.yaml" in text

    def test_a_loop_in_automatic_is_refused_where_nothing_else_is_permitted(self) -> None:
        assert wrong_mode(loop(ALONE), retune_request(), Mode.MANUAL) is None
        text = wrong_mode(loop(ALONE), retune_request(), Mode.AUTOMATIC)
        assert text is not None and "nothing but pulses of the manual output" in text

    def test_a_remote_set_point_is_no_obstacle_in_manual(self) -> None:
        """The set-point is not moved. In automatic it would be."""
        config = loop({**BOTH, "setpoint_from": "remote"})
        check_setpoint_source(config, retune_request())
        check_setpoint_source(config, retune_request(), Mode.MANUAL)
        with pytest.raises(RemoteSetpoint):
            check_setpoint_source(config, retune_request(), Mode.AUTOMATIC)
        with pytest.raises(RemoteSetpoint):
            check_setpoint_source(config, retune_request(method="setpoint"), Mode.MANUAL)


class TestPreview:
    def test_it_says_what_moves_and_that_nothing_is_tried(self) -> None:
        config = BOTH | {"test": BOTH["test"] | {"mv_step_max": 8.0}}
        found = told(replace(IN_MANUAL, sp=90.0), config)
        assert found.would_start, found.obstacles
        assert [each.stage for each in found.stages] == ["preflight", "manual", "design"]
        assert "in manual until it is at rest" in stage(found, "preflight").what
        pulses = stage(found)
        assert (pulses.mv_move_pct, pulses.sp_move) == (8.0, 0.0) and pulses.sp_low is None
        assert (pulses.mv_low_pct, pulses.mv_high_pct) == (STATE.mv - 8.0, STATE.mv + 8.0)
        assert "not tried" in pulses.what and "to both sides in turn" in pulses.what
        assert found.first_mv_move_pct is not None and found.first_mv_move_pct <= 4.0
        assert "in manual again, manual output" in found.on_abort
        assert [each.excitation for each in found.excitations] == ["manual"]
        assert any("How far PV goes is not known beforehand" in line for line in found.summary)

    @pytest.mark.parametrize(
        ("direction", "reverse", "side"),
        [("up", True, 1.0), ("down", True, -1.0), ("up", False, -1.0), ("down", False, 1.0)],
    )
    def test_the_side_is_that_of_PV(self, direction: str, reverse: bool, side: float) -> None:
        config = {"test": BOTH["test"] | {"directions": direction}}
        pulses = stage(told(replace(IN_MANUAL, reverse_acting=reverse), config))
        low, high = pulses.mv_low_pct - STATE.mv, pulses.mv_high_pct - STATE.mv
        assert (low < 0.0, high > 0.0) == (side < 0.0, side > 0.0)

    def test_PV_has_to_be_within_its_limits_and_the_set_point_need_not(self) -> None:
        assert told(replace(IN_MANUAL, sp=1e3), BOTH).would_start
        outside = told(replace(IN_MANUAL, pv=1e3), BOTH)
        assert "bad_limits" in reasons(outside)

    def test_MV_at_its_limit(self) -> None:
        assert "saturated" in reasons(told(replace(IN_MANUAL, mv=99.9), BOTH))

    def test_the_size_of_a_relay_that_is_not_run_is_no_obstacle(self) -> None:
        """MV 80 leaves a relay 20 % at most; the relay is of the loop in automatic."""
        config = {"test": {"excitations": ["relay", "manual"]}}
        assert "bad_limits" in reasons(told(replace(STATE, mv=80.0), config, amplitude_pct=30.0))
        assert told(replace(IN_MANUAL, mv=80.0), config, amplitude_pct=30.0).would_start


def test_the_plan_of_a_loop_in_manual_listens_in_manual() -> None:
    config, request = loop(BOTH), retune_request()
    made = plan(config, request, facts_of(config, IN_MANUAL), mode=Mode.MANUAL)
    assert [getattr(each, "stage", None) for each in next(made)] == ["preflight"]
    made.close()


@pytest.mark.parametrize(("state", "asked"), [(IN_MANUAL, {}), (None, {"excitations": ["manual"]})])
def test_a_dry_run_is_in_manual_where_the_loop_is_or_where_nothing_else_is_asked_for(
    state: LoopState | None, asked: dict[str, Any]
) -> None:
    plant = {"num": [1.0], "den": [8.0, 1.0], "dead_time_s": 2.0, "sample_time_s": 0.1, "noise_std": 0.01}
    request = retune_request(dry_run=True, plant=plant, propose_anyway=True, **asked)
    taken: list[Sample] = []
    ground = Ground() if state is None else Ground(state=state, silence="")
    hooks = Hooks(lambda event: None, taken.extend, lambda: None, ground=ground)
    outcome = rehearse(within(loop(BOTH | {"t95_s": 26.0}), request), request, hooks)
    assert outcome.ended is None, outcome.ended
    assert {sample.mode for sample in taken} == {int(Mode.MANUAL)}
    assert outcome.result is not None and any("never tested" in note for note in outcome.result.notes)
