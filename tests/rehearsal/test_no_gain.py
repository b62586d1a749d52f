"""Loops that are tuned as well as asked already: jobs end as no_gain with their figures, and try nothing on them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from benchmarks.rehearsed import MIDDLE, TS, AroundTheMiddle, entry
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.service.api.job_views import JobView, job_view
from loopwright.service.cli.job_tables import job_report, title
from loopwright.service.execution.procedures import rehearse as dry_run
from loopwright.service.execution.procedures import tune
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.inputs.config import LoopConfig, parse_site
from loopwright.service.inputs.request import retune_request
from loopwright.service.server.assembly import make_jobs
from loopwright.service.states.job_state import JobState
from loopwright.service.store.batches import Part
from loopwright.service.store.store import Store
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from loopwright.tuning.plan import Mode
from tests.rehearsed import rehearse
from tests.unit.service.fakes import ThreadEngine

TAG = "TIC-1"
PLANT = FOPDT(2.0, 6.0, 1.5 + TS / 2)
Ku, Pu = ultimate_point(PLANT)
SLUGGISH = Gains(0.2, 6.0)


def retuned(folder: Path, present: Gains, **options: Any) -> dict[str, Any]:
    """The job of a loop with these gains, as the API shows it."""

    def open_loop(_: LoopConfig) -> RehearsedLoop:
        settings = Settings(mv_low=0.0, mv_high=100.0, safe_output=MIDDLE, pv_low=-200.0, pv_high=200.0, reverse=True)
        channel = Channel(TS, settings, Parameters(present.Kp, present.Ti), 0.0, int(Mode.AUTOMATIC), MIDDLE)
        return RehearsedLoop(AroundTheMiddle(), channel, TS)

    loops = parse_site({"loops": [entry(TAG)]}, "test").loops
    store, engine = Store(folder), ThreadEngine()
    jobs = make_jobs(loops, store, open_loop, tune, dry_run, engine=engine)
    jobs.boot()
    row = jobs.start(TAG, retune_request(**options))
    engine.join(100)
    jobs.stop()
    job = job_view(store.get(row.id), store.events(row.id), None).model_dump(mode="json")
    store.close()
    return job


@cache
def own(method: str) -> Gains:
    """What the method proposes for this loop."""
    spec = {"num": [2.0], "den": [6.0, 1.0], "dead_time_s": 1.5, "sample_time_s": TS, "mv_limits": [-50.0, 50.0],
            "t95_s": 20.0, "sp_deviation": 2.0, "gains": {"Kp": SLUGGISH.Kp, "Ti": SLUGGISH.Ti}}  # fmt: skip
    answer = rehearse(spec, method)
    assert answer["outcome"] == "proposed", answer["detail"]
    return Gains(answer["new_gains"]["Kp"], answer["new_gains"]["Ti"])


@pytest.mark.parametrize("method", ["fast", "five-stage", "simc"])
def test_gains_that_the_method_itself_has_proposed_are_kept(tmp_path: Path, method: str) -> None:
    job = retuned(tmp_path, own(method), method=method)
    assert (job["state"], job["reason"]) == ("no_gain", "no_gain"), job["detail"]
    assert job["detail"].startswith("Nothing asked for gets better by more than 5 %: the present gains are kept")
    assert "already tuned as well as asked" in job["advice"]
    # nothing new was tested on the loop, and what was found is told
    assert "verify" not in [stage["stage"] for stage in job["stages"]]
    assert job["restored"]["gains"]["Kp"] == pytest.approx(own(method).Kp) and not job["restored"]["on_trial"]
    compared = job["comparison"]
    assert not compared["gain"] and compared["verdict"] == job["detail"]
    assert compared["new"]["load"]["IAE"] == pytest.approx(compared["previous"]["load"]["IAE"], rel=0.05)
    assert job["model"] and job["new_gains"]["Kp"] == pytest.approx(own(method).Kp, rel=0.05)
    assert "the loop is already tuned as well as asked, the present gains stay" in title(JobView.model_validate(job))
    job_report(JobView.model_validate(job))


@pytest.mark.parametrize("method", ["fast", "five-stage"])
@pytest.mark.parametrize(
    "present", [SLUGGISH, Gains(0.75 * Ku, Pu), replace(SLUGGISH, Ti=60.0)], ids=["sluggish", "swings", "slow"]
)
def test_badly_tuned_loops_still_get_a_proposal(tmp_path: Path, method: str, present: Gains) -> None:
    job = retuned(tmp_path, present, method=method)
    assert job["state"] == "proposed", job["detail"]
    before, after = job["comparison"]["previous"], job["comparison"]["new"]
    assert job["comparison"]["gain"]
    assert after["load"]["IAE"] < before["load"]["IAE"] or after["Ms"] < before["Ms"] / 1.05
    assert "verify" in [stage["stage"] for stage in job["stages"]]


def test_a_proposal_all_the_same_is_verified_as_any(tmp_path: Path) -> None:
    job = retuned(tmp_path, own("fast"), propose_anyway=True)
    assert (job["state"], job["reason"]) == ("proposed", None), job["detail"]
    assert job["verification"] and not job["comparison"]["gain"]
    assert "proposed because that was asked for" in job["comparison"]["verdict"]


def test_gains_for_a_model_typed_in_are_not_tried_where_they_bring_nothing(tmp_path: Path) -> None:
    model = {"num": [2.0], "den": [6.0, 1.0], "dead_time_s": 1.5}
    kept = retuned(tmp_path / "kept", own("fast"), start="design", model=model)
    assert kept["state"] == "no_gain" and [stage["stage"] for stage in kept["stages"]] == ["preflight", "design"]
    tried = retuned(tmp_path / "tried", own("fast"), start="design", model=model, Ms=1.3)
    assert tried["state"] == "proposed" and tried["step_after"]["settled"], tried["detail"]


def test_a_dry_run_of_such_a_loop_is_rehearsed_and_says_so(tmp_path: Path) -> None:
    model = {"num": [2.0], "den": [6.0, 1.0], "dead_time_s": 1.5}
    job = retuned(tmp_path, own("fast"), dry_run=True, model=model)
    assert (job["state"], job["reason"]) == ("rehearsed", None)
    assert job["comparison"]["verdict"].startswith("Nothing asked for gets better")


def test_among_many_it_is_no_failure() -> None:
    for state in (JobState.NO_GAIN, JobState.REHEARSED):
        part = Part(1, TAG, "4f0c", state, None, None)
        assert not part.failed and not part.waiting and part.state(True) == state.value
