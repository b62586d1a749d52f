"""A dry run: what it rehearses on, and that nobody takes it for a proposal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from loopwright.service.api.job_views import JobView, job_view
from loopwright.service.cli import job_tables
from loopwright.service.execution.procedures import Hooks, rehearse
from loopwright.service.inputs.model_json import TransferFunctionModel
from loopwright.service.inputs.request import FastRetune, PlantModel, retune_request
from loopwright.service.planning.found_model import DISPROVED
from loopwright.service.planning.ground import Ground, LastModel, rehearsal_spec
from loopwright.service.results import FastResult, GainsSource, PlantSource, TransferModelView
from loopwright.service.states.job_state import JobState
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.service.fakes import NEW, OLD, RESULT, TAG, FakeLoop, Service

FOUND = LastModel(FOPDT(2.0, 3.0, 1.0), "4f0c", "2026-01-31T12:00:00.000Z")
PLANT = PlantModel(num=[0.2], den=[2.4, 1.0], dead_time_s=1.8, sample_time_s=0.2)
QUICK = {"dry_run": True, "verify": False}


def ground_with(service: Service, **changes: Any) -> Ground:
    return Ground(FOUND, replace(service.controller.state, **changes), silence="")


def dry_run(service: Service, **options: Any) -> JobView:
    """A dry run of the real procedure, to its end."""
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearse)
    row = jobs.start(TAG, retune_request(**QUICK | options))
    service.wait(row.id)
    jobs.stop()
    return shown(service, row.id)


def shown(service: Service, job_id: str) -> JobView:
    return job_view(service.store.get(job_id), service.store.events(job_id), None)


def proposed(service: Service) -> str:
    """The id of a live job that has proposed."""
    row = service.jobs.start(TAG, FastRetune())
    service.wait(row.id)
    assert service.store.get(row.id).state == "proposed"
    return row.id


def test_the_plant_given_comes_before_the_last_model_and_that_before_a_guess(service: Service) -> None:
    config, known = service.loops[TAG], ground_with(service)
    model = TransferFunctionModel(num=[3.0], den=[5.0, 1.0], dead_time_s=2.0)
    for request, ground, source, num in (
        (retune_request(dry_run=True, plant=PLANT), known, PlantSource.GIVEN, [0.2]),
        (retune_request(dry_run=True, model=model), known, PlantSource.GIVEN, [3.0]),
        (retune_request(dry_run=True), known, PlantSource.LAST_MODEL, [2.0]),
        (retune_request(dry_run=True), Ground(), PlantSource.GUESSED, [0.2]),
    ):
        spec, on = rehearsal_spec(config, request, ground)
        assert (on.plant_source, on.num, spec["num"]) == (source, num, num)
        assert (on.plant_job, on.plant_job_ended_at) == (
            (f"/jobs/{FOUND.job}", FOUND.ended_at) if source is PlantSource.LAST_MODEL else (None, None)
        )


def test_a_guess_fits_the_configuration_of_the_loop(service: Service) -> None:
    config = service.loops[TAG]
    spec, on = rehearsal_spec(config, retune_request(dry_run=True), Ground())
    time_constant, dead_time = spec["den"][0], spec["dead_time_s"]
    assert dead_time + 3 * time_constant == pytest.approx(config.t95_s)
    assert spec["num"][0] * 10.0 == pytest.approx(config.sp_deviation)
    assert spec["mv_limits"] == [-50.0, 50.0] and "gains" not in spec
    assert on.plant_text.startswith("a guessed plant (from T95 9 s")
    assert on.gains_source is GainsSource.ASSUMED and "the controller did not answer" in on.gains_text


def test_the_controller_gives_gains_sample_time_limits_and_action(service: Service) -> None:
    ground = ground_with(service, gains=Gains(0.4, 3.0, 0.5, 0.1, 0.7), sample_time_s=0.05, mv_low=20.0, mv_high=80.0)
    spec, on = rehearsal_spec(service.loops[TAG], retune_request(dry_run=True), ground)
    assert spec["gains"] == {"Kp": 0.4, "Ti": 3.0, "Td": 0.5, "Tf": 0.1, "b": 0.7, "c": 0.0}
    assert (spec["sample_time_s"], spec["mv_limits"], spec["reverse_acting"]) == (0.05, [-30.0, 30.0], True)
    assert on.gains_source is GainsSource.CONTROLLER


@pytest.mark.parametrize("reverse", [True, False])
def test_a_guessed_plant_is_one_on_which_the_present_gains_work(service: Service, reverse: bool) -> None:
    ground = replace(ground_with(service, gains=Gains(400.0, 2.0), reverse_acting=reverse), last_model=None)
    spec, on = rehearsal_spec(service.loops[TAG], retune_request(dry_run=True), ground)
    plant = FOPDT(spec["num"][0], spec["den"][0], spec["dead_time_s"])
    assert margins(plant, Gains(400.0, 2.0)).stable and (plant.K > 0.0) == reverse
    assert "the present gains are stable on it" in on.plant_text


def test_a_dry_run_takes_the_model_that_the_last_job_found_and_the_gains_of_the_loop(service: Service) -> None:
    job_id = proposed(service)
    view = dry_run(service)
    on = view.rehearsed_on
    assert view.state is JobState.REHEARSED and on is not None
    assert (on.plant_source, on.plant_job, on.num, on.dead_time_s) == ("last_model", f"/jobs/{job_id}", [2.0], 1.0)
    assert on.plant_job_ended_at == service.store.get(job_id).ended_at
    assert on.gains_source == "controller" and view.previous_gains is not None and view.previous_gains.Kp == OLD.Kp
    assert view.comparison is not None and view.comparison.verdict
    assert any(f"the model that job {job_id} found" in note for note in view.notes)
    title = job_tables.title(view)
    assert "rehearsed on the model that job" in title and title.endswith("nothing was tested")
    assert "proposed" not in title


def test_neither_a_dry_run_nor_a_model_that_was_disproved_or_typed_in_is_the_last_model(service: Service) -> None:
    dry_run(service, plant=PLANT)
    service.tune.ends = Refused(DISPROVED[1], "made up")
    service.wait(service.jobs.start(TAG, FastRetune()).id)
    typed_in = service.store.create(TAG, {}, "me", False)
    model = TransferModelView(structure="typed in", num=[9.0], den=[1.0, 1.0], dead_time_s=1.0)
    result = FastResult(method="fast", model=model, new_gains=RESULT.new_gains)
    service.store.move(typed_in.id, JobState.RUNNING)
    service.store.move(typed_in.id, JobState.PROPOSED, result=result)
    view = dry_run(service)
    assert view.rehearsed_on is not None and view.rehearsed_on.plant_source == "guessed"
    title = job_tables.title(view)
    assert title == (
        f"job {view.id}: {TAG} rehearsed on a guessed plant (from T95 9 s, MV 0 to 100 %, step 2), nothing was tested"
    )


def test_a_controller_that_is_not_there_is_said_so_and_hinders_nothing(service: Service) -> None:
    service.controller.absent = Reason.NODE_LOST
    view = dry_run(service)
    on = view.rehearsed_on
    assert view.state is JobState.REHEARSED and on is not None
    assert on.gains_source == "assumed" and "node_lost: node 32 does not answer" in on.gains_text


def test_then_the_gains_are_those_that_the_last_job_left(service: Service) -> None:
    job_id = proposed(service)
    service.jobs.decisions.accept(job_id, "me")
    service.controller.absent = Reason.NODE_LOST
    view = dry_run(service)
    on = view.rehearsed_on
    assert on is not None and (on.gains_source, on.gains_job) == ("last_job", f"/jobs/{job_id}")
    assert view.previous_gains is not None and view.previous_gains.Kp == NEW.Kp
    assert f"as job {job_id} found them" in on.gains_text


def test_beside_a_test_the_gains_are_those_from_before_it(tmp_path: Path) -> None:
    service = Service(tmp_path, rehearse=rehearse)  # one service: another one's start would go on with the test
    service.tune.hold.clear()
    live = service.jobs.start(TAG, FastRetune())
    assert service.tune.inside.wait(60)
    assert service.controller.state.gains == NEW and service.controller.state.on_trial
    row = service.jobs.start(TAG, retune_request(**QUICK))
    service.wait(row.id)
    view = shown(service, row.id)
    assert view.previous_gains is not None and view.previous_gains.Kp == OLD.Kp
    service.tune.hold.set()
    service.wait(live.id)
    service.close()


def test_a_loop_that_is_in_manual_can_be_rehearsed(service: Service) -> None:
    service.controller.state = replace(service.controller.state, mode=Mode.MANUAL, mv=0.0)
    assert dry_run(service).state is JobState.REHEARSED


def test_a_refused_rehearsal_says_what_it_was_on(service: Service) -> None:
    view = dry_run(service, plant=PlantModel(num=[-0.2], den=[2.4, 1.0], dead_time_s=1.8))
    assert (view.state, view.reason) == (JobState.REFUSED, "wrong_sign"), view.detail
    assert view.rehearsed_on is not None and view.rehearsed_on.plant_source == "given"
    assert job_tables.title(view).endswith("refused on the plant given, nothing was tested")


@pytest.mark.parametrize(
    ("changes", "options", "words"),
    [
        ({"t95_s": 1e-300}, {}, "t95_s: 1e-300 is not plausible"),
        ({"t95_s": 1e300}, {}, "t95_s: 1e+300 is not plausible"),
        ({}, {"num": [1.0], "den": [1.0, 1.0], "dead_time_s": 80.0, "sample_time_s": 1e-4}, "8e+05 times in"),
    ],
)
def test_an_extreme_one_is_refused_by_name(
    service: Service, changes: dict[str, Any], options: dict[str, Any], words: str
) -> None:
    """What the request itself shows is refused at the edge (test_plausible); this is what shows later."""
    config = service.loops[TAG].model_copy(update=changes)
    request = retune_request(dry_run=True, plant=PlantModel(**options) if options else None)
    quiet = Hooks(lambda event: None, lambda samples: None, lambda: None)
    ended = rehearse(config, request, quiet).ended
    assert ended is not None and ended.reason is Reason.BAD_INPUT and words in ended.detail, ended


def test_a_sample_time_too_short_for_a_rehearsal_is_replaced_and_that_is_said(service: Service) -> None:
    config = service.loops[TAG].model_copy(update={"t95_s": 30_000.0})
    spec, on = rehearsal_spec(config, retune_request(dry_run=True), ground_with(service))
    assert "sample_time_s" not in spec and "the sample time 0.1 s is too short for this T95" in on.gains_text
