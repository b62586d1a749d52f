"""What a retune would do, told before it starts: by the pure function, over HTTP, and refused by the work itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.api.gate.gate import scope_for
from loopwright.service.execution.procedures import Hooks, tune
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import FastRetune, retune_request, within
from loopwright.service.observing.knowledge import known
from loopwright.service.planning.moves import broken_limits
from loopwright.service.planning.obstacles import Now
from loopwright.service.planning.preview import LastProposal, Preview, duration_text, preview
from loopwright.service.results import Finding, FindingSource, KnowledgeView
from loopwright.service.security.keys import Scope
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.knowledge import Known
from loopwright.service.store.store import Store
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Failed, Reason, Refused
from tests.unit.service.fakes import RESULT, TAG, FakeController, FakeLoop, Service, loop_entry
from tests.unit.service.observing.findings import OTHER, PRESENT, PROPOSED, finding, gains

STATE = FakeController().state
EITHER = {"test": {"excitations": ["setpoint", "relay"]}}
NARROW = {"pv_limits": {"low": 49.0, "high": 53.0}}


def told(state: LoopState | None = STATE, config: dict[str, Any] | None = None, **options: Any) -> Preview:
    loop = LoopConfig.model_validate(loop_entry(**(config or {})))
    return preview(loop, retune_request(**options), Now(state), None)


def reasons(found: Preview) -> list[str]:
    return [each.reason for each in found.obstacles]


ALL = {"test": {"excitations": ["observe", "setpoint", "relay"]}}


def known_of(found: Finding, gains: Gains = PRESENT) -> KnowledgeView:
    view = known([Known(1, found, None)], gains)
    assert view is not None
    return view


class TestExcitations:
    """The plant of `findings`: a lag of 8 s with a gain of 1 and a dead time of 0.95 s, so that Pu is about 4 s."""

    def told(self, knowledge: KnowledgeView | None, noise: float | None = 0.02, **options: Any) -> Preview:
        loop = LoopConfig.model_validate(loop_entry(**ALL, noise_std_hint=noise))
        state = replace(STATE, gains=PRESENT)
        return preview(loop, retune_request(**options), Now(state), None, knowledge)

    def test_with_a_model_it_is_predicted_what_each_tells(self) -> None:
        found = self.told(known_of(finding()))
        assert [each.excitation for each in found.excitations] == ["observe", "setpoint", "relay"]
        step, _, relay = found.excitations
        assert "only the step under the new gains moves the loop" in step.when and "Ms known to +-0.05" in step.when
        assert relay.when.startswith("Only where what comes before tells too little")
        for each in found.excitations:
            assert each.Ms_uncertainty is not None and 0.0 < each.Ms_uncertainty < 0.1
            assert each.information_per_pu is not None and each.duration_s is not None
            periods = each.duration_s / 3.9  # Pu of K = 1, T = 8 s, L = 1 s, by w L + atan(w T) = pi
            assert 1.8 < periods < 12.5
            assert each.information_per_pu == pytest.approx(4.0 / each.Ms_uncertainty**2 / periods, rel=0.1)
        pulses_told = next(line for line in found.summary if line.startswith("setpoint: Only where"))
        assert "It would tell Ms to +-" in pulses_told

    def test_twice_the_noise_leaves_twice_the_uncertainty(self) -> None:
        few, many = (self.told(known_of(finding()), noise).excitations[0] for noise in (0.01, 0.02))
        assert many.Ms_uncertainty == pytest.approx(2.0 * (few.Ms_uncertainty or 0.0), rel=0.02)

    @pytest.mark.parametrize(
        ("knowledge", "said"),
        [
            (None, "Operation has not shown the plant yet"),
            (known_of(finding(), OTHER), "under other gains"),
            (known_of(finding(proposed=gains(PROPOSED, 1.42, 0.2))), "more than 0.06 for the new gains"),
            (known_of(finding(source=FindingSource.JOB, changes=None, job="1")), "Operation has not shown"),
        ],
    )
    def test_why_operation_does_not_do_is_told(self, knowledge: KnowledgeView | None, said: str) -> None:
        observe = self.told(knowledge).excitations[0]
        assert said in observe.when and "looked at again as the job begins" in observe.when

    def test_without_a_model_or_the_noise_nothing_is_predicted(self) -> None:
        for found in (self.told(None), self.told(known_of(finding()), None)):
            assert {each.information_per_pu for each in found.excitations} == {None}

    def test_other_methods_and_dry_runs_have_no_such_choice(self) -> None:
        assert self.told(None, method="five-stage").excitations == []
        assert [each.excitation for each in self.told(None, dry_run=True).excitations] == ["setpoint", "relay"]


class TestMoves:
    def test_fast_moves_mv_by_the_relay_and_the_set_point_once(self) -> None:
        """MV 40 of 0 .. 100: 60 % up, and half of that down."""
        found = told()
        stages = {each.stage: each for each in found.stages}
        assert list(stages) == ["preflight", "relay", "design", "verify", "redesign"]
        relay = stages["relay"]
        assert (relay.mv_low_pct, relay.mv_high_pct, relay.mv_move_pct, relay.sp_move) == (10.0, 100.0, 60.0, 0.0)
        assert (stages["verify"].sp_low, stages["verify"].sp_high) == (50.0, 52.0)
        assert stages["preflight"].mv_move_pct == stages["design"].mv_move_pct == 0.0
        assert (found.largest_mv_move_pct, found.largest_sp_move, found.would_start) == (60.0, 2.0, True)
        assert relay.pv_move is stages["verify"].pv_move is found.largest_pv_move is None, "no model is known"
        assert found.first_mv_move_pct is not None and found.first_mv_move_pct <= 30.0
        assert (found.watched.pv.low, found.watched.pv.high, found.watched.max_time_s) == (0.0, 100.0, 900.0)

    def test_the_largest_jump_of_mv_that_the_loop_permits_bounds_what_is_told(self) -> None:
        """A relay jumps from one side to the other: by one and a half amplitudes, or by two where it is even."""
        jump = {"test": {"mv_step_max": 6.0}}
        assert told(config=jump).largest_mv_move_pct == 4.0
        five_stages = {each.stage: each for each in told(config=jump, method="five-stage").stages}
        assert five_stages["relay"].mv_move_pct == 3.0
        asked = told(config=jump, amplitude_pct=5.0)
        assert not asked.would_start and "at most 4 fits" in asked.obstacles[0].detail

    def test_of_two_excitations_each_that_may_follow_is_told_before(self) -> None:
        found = told(config=EITHER)
        stages = {each.stage: each for each in found.stages}
        assert list(stages) == ["preflight", "pulses", "relay", "design", "verify", "redesign"]
        assert (stages["pulses"].sp_low, stages["pulses"].sp_high) == (48.0, 52.0)
        assert stages["relay"].what.startswith("Only where the pulses tell too little") and found.first_mv_move_pct
        assert stages["relay"].duration_low_s == 0.0 < stages["pulses"].duration_low_s
        assert "After pulses" in stages["verify"].what and "After the relay" in stages["verify"].what
        assert found.largest_mv_move_pct == told().largest_mv_move_pct, "the relay's"

    def test_of_a_plant_that_operation_may_have_shown_the_trial_is_told_first(self) -> None:
        found = told(config={"test": {"excitations": ["observe", "setpoint"]}})
        stages = {each.stage: each for each in found.stages}
        assert list(stages) == ["preflight", "trial", "pulses", "design", "verify", "redesign"]
        assert stages["trial"].what.startswith("Only where operation has shown the plant well enough")
        assert (stages["trial"].sp_low, stages["trial"].sp_high) == (50.0, 52.0)
        assert stages["pulses"].duration_low_s == 0.0 < stages["trial"].duration_low_s
        alone = told(config={"test": {"excitations": ["observe"]}})
        assert [each.stage for each in alone.stages] == ["preflight", "design", "trial", "redesign"]

    def test_pulses_alone_are_told_as_those_of_method_setpoint(self) -> None:
        alone = told(config=EITHER, excitations=["setpoint"])
        assert [each.model_dump() for each in alone.stages] == [
            each.model_dump() for each in told(method="setpoint").stages
        ]

    @pytest.mark.parametrize(
        ("config", "options", "words"),
        [
            ({}, {"excitations": ["setpoint"]}, "setpoint is asked for, loops.yaml permits relay"),
            (EITHER, {"excitations": ["setpoint"], "amplitude_pct": 5.0}, "amplitude_pct: of a relay, which is not"),
            (EITHER | {"setpoint_from": "remote"}, {"excitations": ["setpoint"]}, "comes from another controller"),
        ],
    )
    def test_a_request_does_not_widen_what_the_loop_permits(
        self, config: dict[str, Any], options: dict[str, Any], words: str
    ) -> None:
        found = told(config=config, **options)
        assert not found.would_start and words in found.obstacles[0].detail

    def test_a_remote_set_point_is_left_alone_where_the_relay_is_permitted(self) -> None:
        found = told(config=EITHER | {"setpoint_from": "remote"})
        assert [each.stage for each in found.stages][1] == "relay" and found.would_start

    def test_an_amplitude_that_is_asked_for_is_the_one_told(self) -> None:
        found = told(amplitude_pct=10.0)
        assert found.first_mv_move_pct == 10.0
        # a side on which PV stalls is raised up to twice
        assert found.largest_mv_move_pct == 20.0 and found.stages[1].mv_low_pct == 30.0

    def test_the_narrower_of_the_limits_counts(self) -> None:
        found = told(replace(STATE, mv_high=70.0), mv_low=20.0)
        assert (found.watched.mv.low, found.watched.mv.high) == (20.0, 70.0)
        assert (found.stages[1].mv_low_pct, found.stages[1].mv_high_pct) == (25.0, 70.0)

    def test_pulses_go_to_both_sides_of_the_set_point(self) -> None:
        stages = {each.stage: each for each in told(method="setpoint").stages}
        assert list(stages) == ["preflight", "pulses", "design", "verify", "redesign"]
        assert (stages["pulses"].sp_low, stages["pulses"].sp_high) == (48.0, 52.0)
        assert (stages["verify"].sp_low, stages["verify"].sp_high) == (50.0, 52.0)

    def test_five_stage_tells_every_stage(self) -> None:
        found = told(method="five-stage")
        names = [each.stage for each in found.stages]
        assert names == ["preflight", "baseline", "relay", "ultimate", "zn_pi", "estimate", "optimise", "verify"]
        assert found.largest_mv_move_pct == 40.0, "the room on the nearer side"
        moved = {each.stage: each.sp_move for each in found.stages}
        assert moved["relay"] == 0.0 and moved["baseline"] == moved["zn_pi"] == 2.0
        assert found.largest_pv_move is None, "the relay takes all the room, whatever PV does"
        shorter = told(method="simc", start="zn_pi", Ku=2.0, Pu_s=3.0, baseline=False, verify=False)
        assert [each.stage for each in shorter.stages] == ["preflight", "zn_pi", "estimate", "optimise"]

    def test_the_old_gains_bound_the_first_step_of_five_stage(self) -> None:
        found = told(replace(STATE, gains=replace(STATE.gains, Kp=100.0)), method="five-stage")
        assert found.stages[1].sp_move == pytest.approx(0.7 * 40.0 / 100.0)

    def test_a_dry_run_moves_nothing(self) -> None:
        found = told(replace(STATE, mode=Mode.MANUAL), dry_run=True)
        assert found.stages == [] and found.largest_mv_move_pct == 0.0 and found.would_start

    def test_a_trial_has_no_relay(self) -> None:
        found = told(start="design", model={"K": 0.8, "T_s": 3.0, "L_s": 1.0})
        assert [each.stage for each in found.stages] == ["preflight", "design", "verify"]
        assert found.first_mv_move_pct is None and found.largest_sp_move == 2.0

    def test_without_the_controller_the_file_alone_tells(self) -> None:
        found = told(None)
        assert found.mv is found.sp is found.stages[1].mv_low_pct is None
        assert found.largest_mv_move_pct == pytest.approx(200.0 / 3.0), "two thirds of the range, wherever MV is"
        assert any("could not be read" in line for line in found.summary)


class TestTime:
    def test_the_last_model_narrows_the_estimate(self) -> None:
        loop = LoopConfig.model_validate(loop_entry())
        last = LastProposal.of("abc", "2026-01-31T12:00:00.000Z", 30.0, RESULT)
        one, other = (preview(loop, FastRetune(), Now(STATE), known) for known in (None, last))
        assert "T95 9 s" in one.duration_basis and "abc" in other.duration_basis
        ratios = [each.duration_high_s / each.duration_low_s for each in (one, other)]
        assert ratios[1] < ratios[0]
        assert (other.known.Pu_s, other.known.model, other.known.model_job) == (3.32, "fopdt", "/jobs/abc")
        assert one.known.model is None and one.known.t95_s == 9.0

    def test_the_stages_last_as_long_as_the_whole(self) -> None:
        for method in ("fast", "five-stage"):
            found = told(method=method)
            assert found.duration_high_s == pytest.approx(sum(each.duration_high_s for each in found.stages))
            assert 0.0 < found.duration_low_s < found.duration_high_s

    @pytest.mark.parametrize(
        ("low", "high", "text"),
        [
            (5.0, 41.2, "5.0 to 41 s"),
            (0.0, 130.0, "up to 130 s"),
            (90.0, 600.0, "1.5 to 10 min"),
            (0, 2e4, "up to 5.6 h"),
        ],
    )
    def test_times_are_told_in_a_unit_that_suits_them(self, low: float, high: float, text: str) -> None:
        assert duration_text(low, high) == text


class TestObstacles:
    def test_all_at_once(self) -> None:
        state = replace(STATE, mode=Mode.MANUAL, mv=1.0, pv=53.5, sp=52.5, node_state="node 10h is stopped")
        found = told(state, NARROW | {"noise_std_hint": 0.3})
        assert reasons(found) == [
            "node_not_operational", "wrong_mode", "bad_limits", "saturated", "pv_limit", "noise_too_high",
        ]  # fmt: skip
        assert not found.would_start and all(each.detail and each.advice for each in found.obstacles)

    @pytest.mark.parametrize(
        ("state", "options", "reason", "words"),
        [
            ({"mode": Mode.OFF}, {}, "wrong_mode", "mode off"),
            ({"mode": Mode.EXPERIMENT}, {}, "loop_in_use", "no job of this service"),
            ({"on_trial": True}, {}, "loop_in_use", "on trial"),
            ({"mv": 97.0}, {}, "saturated", "leaves 3 of room"),
            ({"pv": 52.0}, {}, "not_at_rest", "+2 degC off"),
            ({"pv": float("nan")}, {}, "bad_sample", "nan"),
            ({"sample_time_s": 2.0}, {}, "sampling_too_slow", "T95 9 s"),
            ({"mv_low": 70.0}, {"mv_high": 60}, "bad_limits", "mv_low 70"),
            ({"mv": 80.0}, {"amplitude_pct": 30}, "bad_limits", "at most 20 fits"),
            ({}, {"amplitude_pct": 70}, "bad_limits", "needs 105 %"),
            ({}, {"mv_high": 110}, "bad_limits", "wider"),
            (
                {"reverse_acting": False},
                {"start": "design", "model": {"K": 1, "T_s": 3, "L_s": 1}},
                "wrong_sign",
                "sign",
            ),
        ],
    )
    def test_each(self, state: dict[str, Any], options: dict[str, Any], reason: str, words: str) -> None:
        found = told(replace(STATE, **state), **options)
        assert reasons(found) == [reason] and words in found.obstacles[0].detail

    def test_one_reading_is_not_the_mean_of_many(self) -> None:
        """PV 0.3 off is three standard deviations of the noise that a step of 2 permits, and may well be at rest."""
        assert told(replace(STATE, pv=50.3)).would_start
        assert reasons(told(replace(STATE, pv=50.3), {"noise_std_hint": 0.01})) == ["not_at_rest"]

    def test_a_dry_run_counts_the_limits_alone(self) -> None:
        assert reasons(told(replace(STATE, mode=Mode.OFF), dry_run=True, mv_high=110)) == ["bad_limits"]


class TestBrokenLimits:
    """Limits of PV that the test itself would break."""

    @pytest.mark.parametrize("method", ["fast", "five-stage", "simc"])
    @pytest.mark.parametrize(
        ("sp", "pv_high", "words"),
        [
            (50.0, 51.5, "above the PV limit 51.5: ask for an sp_deviation of at most 1."),
            (52.0, 51.5, "52 degC is not within the PV limits 0 .. 51.5"),
            (51.5, 51.5, "move the set-point, or permit more PV"),
        ],
    )
    def test_a_step_over_the_limit(self, method: str, sp: float, pv_high: float, words: str) -> None:
        request = retune_request(method=method, pv_high=pv_high)
        config = within(LoopConfig.model_validate(loop_entry()), request)
        (text,) = broken_limits(config, request, sp)
        assert words in text

    def test_five_stage_needs_room_for_its_overshoot(self) -> None:
        config = LoopConfig.model_validate(loop_entry(pv_limits={"low": 0.0, "high": 52.1}))
        assert broken_limits(config, FastRetune(), 50.0) == []
        (text,) = broken_limits(config, retune_request(method="five-stage"), 50.0)
        assert "overshoot of 10 %" in text and "52.2" in text and "at most 1.909 degC" in text

    def test_the_relay_of_fast_may_move_pv_to_either_side(self) -> None:
        config = LoopConfig.model_validate(loop_entry(pv_limits={"low": 49.0, "high": 60.0}))
        (text,) = broken_limits(config, FastRetune(), 50.0)
        assert "below the PV limit 49: ask for an sp_deviation of at most 1 degC" in text
        assert broken_limits(config, retune_request(amplitude_pct=5), 50.0) == [], "its size has nothing to do with it"
        known = retune_request(**{"start": "design", "model": {"K": 1, "T_s": 3, "L_s": 1}})
        assert broken_limits(config, known, 50.0) == [], "a trial only steps the set-point up"

    def test_a_set_point_as_float32_is_not_over_the_limit(self) -> None:
        config = LoopConfig.model_validate(loop_entry(pv_limits={"low": 0.0, "high": 50.1}, sp_deviation=0.1))
        assert broken_limits(config, FastRetune(), 50.000000745) == []

    @pytest.mark.parametrize("method", ["fast", "five-stage", "simc"])
    def test_the_work_refuses_before_it_touches_the_loop(self, method: str) -> None:
        controller = FakeController()
        request = retune_request(method=method, pv_high=51.0)
        config = within(LoopConfig.model_validate(loop_entry()), request)
        hooks = Hooks(lambda event: None, lambda samples: None, lambda: None)
        with pytest.raises(Refused, match=r"52(\.2)?, above the PV limit 51") as refused:
            tune(config, request, FakeLoop(controller), controller.state, hooks)
        assert refused.value.reason is Reason.BAD_LIMITS and controller.session_last == 0


class TestHttp:
    def ask(self, client: TestClient, **options: Any) -> dict[str, Any]:
        answer = client.post(f"/loops/{TAG}/retune/preview", json=options)
        assert answer.status_code == 200, answer.text
        body: dict[str, Any] = answer.json()
        return body

    def test_it_changes_nothing(self, service: Service, client: TestClient) -> None:
        before = service.controller.state
        found = self.ask(client, method="five-stage")
        assert found["would_start"] and found["stages"][1]["stage"] == "baseline"
        assert service.store.recent() == [] and service.controller.session_last == 0 == service.controller.open
        assert service.controller.state == before
        assert client.get("/audit").json() == []

    def test_a_silent_controller(self, service: Service, client: TestClient) -> None:
        service.controller.absent = Reason.NODE_LOST
        found = self.ask(client)
        assert [each["reason"] for each in found["obstacles"]] == ["node_lost"] and found["mv"] is None

    def test_a_busy_loop_is_told_as_its_job_has_found_it(self, service: Service, client: TestClient) -> None:
        service.tune.hold.clear()
        job = client.post(f"/loops/{TAG}/retune", json={"by": "me"}).json()
        assert service.tune.inside.wait(5)
        service.controller.state = replace(service.controller.state, sp=52.0, mode=Mode.EXPERIMENT)
        found = self.ask(client)
        assert [(each["reason"], each["job"]) for each in found["obstacles"]] == [("busy", job["url"])]
        assert found["sp"] == 50.0
        service.tune.hold.set()
        service.wait(job["id"])

    def test_a_lock_is_told(self, service: Service, client: TestClient) -> None:
        client.post(f"/loops/{TAG}/lock", json={"reason": "valve is being overhauled", "by": "night shift"})
        (obstacle,) = self.ask(client)["obstacles"]
        assert obstacle["reason"] == "locked" and "valve is being overhauled" in obstacle["detail"]
        many = client.post("/batches/preview", json={"loops": [TAG]}).json()
        assert "locked" in str(many)

    def test_the_last_model_is_known_and_no_dry_run_counts(self, service: Service, client: TestClient) -> None:
        assert self.ask(client)["known"]["model_job"] is None
        asked = [{"dry_run": dry, "by": "me"} for dry in (False, True)]
        jobs = [client.post(f"/loops/{TAG}/retune", json=each).json()["id"] for each in asked]
        for job in jobs:
            service.wait(job)
        service.tune.ends = Failed(Reason.NODE_LOST, "silent")
        service.wait(client.post(f"/loops/{TAG}/retune", json={"by": "me"}).json()["id"])
        known = self.ask(client)["known"]
        assert (known["model_job"], known["Pu_s"]) == (f"/jobs/{jobs[0]}", 3.32)
        after = self.ask(client)
        assert after["pv_known_by"] == f"the model that job {jobs[0]} found"
        assert after["pv_low"] < 50.0 < after["pv_high"], "computed by the pool, on that model"

    def test_limits_that_the_file_does_not_permit_are_told_with_the_rest(
        self, service: Service, client: TestClient
    ) -> None:
        service.controller.state = replace(service.controller.state, mode=Mode.MANUAL)
        found = self.ask(client, sp_deviation=3, mv_high=110)
        assert [each["reason"] for each in found["obstacles"]] == ["bad_limits", "bad_limits", "wrong_mode"]
        assert client.post(f"/loops/{TAG}/retune/preview", json={"Ms": 9}).status_code == 422
        assert client.post("/loops/NONE/retune/preview").status_code == 404

    def test_many_loops(self, service: Service, client: TestClient) -> None:
        service.controller.absent = Reason.NODE_LOST  # no controller is asked
        answer = client.post("/batches/preview", json={"pattern": "*", "amplitude_pct": 10})
        found = answer.json()
        assert (found["count"], found["would_start"], found["largest_mv_move_pct"]) == (2, 2, 20.0)
        assert [each["loop"] for each in found["loops"]] == sorted(service.loops)
        assert service.store.recent() == [] and client.get("/batches").json() == []
        refused = client.post("/batches/preview", json={"loops": [TAG, "NONE"]})
        assert refused.status_code == 422 and "NONE" in refused.json()["detail"]

    def test_a_key_that_may_only_read_may_ask(self) -> None:
        for path in (f"/loops/{TAG}/retune/preview", "/batches/preview", "/loops/{tag}/retune/preview"):
            assert scope_for("POST", path) is Scope.READ
        for path in (f"/loops/{TAG}/retune", "/batches", "/loops/a/b/retune/preview", f"/loops/{TAG}/retune/preview/x"):
            assert scope_for("POST", path) is Scope.OPERATE


def test_last_models_of_every_loop(store: Store) -> None:
    assert store.last_models() == {} == store.last_models(TAG)
