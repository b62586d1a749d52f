"""GET /jobs/{id}/record and GET /jobs/{id}/designs: once computed and stored, the same for all who ask."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import control
import numpy as np
import pytest
from fastapi.testclient import TestClient
from scipy.signal import cont2discrete, dlsim, tf2ss
from sqlalchemy.exc import SQLAlchemyError

from benchmarks.rehearsed import MIDDLE, TS, entry
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.api.report.paper import paper
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool
from loopwright.service.execution.procedures import rehearse, tune
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.inputs.config import LoopConfig, parse_site
from loopwright.service.inputs.request import retune_request
from loopwright.service.jobs import job_figures
from loopwright.service.jobs.design_curve import DesignPoint
from loopwright.service.jobs.job_record import driven, job_record, unpack
from loopwright.service.jobs.kept_figures import KeptFigures
from loopwright.service.jobs.manager import Jobs
from loopwright.service.jobs.retention import RetentionPolicy, delete_old_samples
from loopwright.service.jobs.stored_record import Attempt, last_attempt, record_columns
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.store import Store
from loopwright.tuning.models import FOPDT, Integrating, Model, TransferFunction
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.api.test_api import assert_problem, finished, start
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import Service, ThreadEngine
from tests.unit.service.processes import until

LOOP = "TIC-1"
K, T, L = 2.0, 6.0, 1.5


class Counting(Pool):
    """A pool that counts what it computes, and computes in this process. hold: cleared, it waits."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        self.hold = threading.Event()
        self.hold.set()

    def run(self, kind: ComputationKind, work: Any, **_: Any) -> Any:
        assert kind is ComputationKind.TUNING
        if work.func is job_figures.job_figures:
            assert self.hold.wait(60.0)
            self.count += 1
        return work()


class Here:
    """Jobs on a plant in memory, and the pool that computes their figures."""

    def __init__(self, folder: Path) -> None:
        def open_loop(_: LoopConfig) -> RehearsedLoop:
            settings = Settings(0.0, 100.0, safe_output=MIDDLE, pv_low=-200.0, pv_high=200.0, reverse=True)
            channel = Channel(TS, settings, Parameters(0.2, 6.0), 0.0, int(Mode.AUTOMATIC), MIDDLE)
            return RehearsedLoop(Offset(), channel, TS)

        loops = parse_site({"loops": [entry(LOOP) | {"sp_deviation": 5.0}]}, "test").loops
        self.store, self.engine, self.pool = Store(folder), ThreadEngine(), Counting()
        self.figures = KeptFigures(self.store, self.pool)
        self.jobs: Jobs = make_jobs(
            loops, self.store, open_loop, tune, rehearse, engine=self.engine, ended=self.figures.ended
        )
        self.jobs.boot()

    def finished(self, **options: Any) -> str:
        row = self.jobs.start(LOOP, retune_request(**options))
        self.engine.join(120.0)
        return row.id

    def client(self) -> TestClient:
        return TestClient(app_of(self.jobs, pool=self.pool, figures=self.figures), raise_server_exceptions=False)


class Offset:
    def __init__(self) -> None:
        self._plant = LinearPlant([K], [T, 1.0], L, TS, noise_std=0.05, seed=3)

    @property
    def pv(self) -> float:
        return self._plant.pv

    def step(self, mv: float) -> float:
        return self._plant.step(mv - MIDDLE)


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Here]:
    here = Here(tmp_path_factory.mktemp("figures"))
    yield here
    here.jobs.stop()
    here.figures.close()
    here.store.close()


@pytest.fixture(scope="module")
def job(here: Here) -> str:
    return here.finished()


def peak_of_sensitivity(curve: dict[str, Any], gains: dict[str, Any]) -> float:
    """Ms on a fine grid by python-control, which `tuning` does not use; the dead time is exact."""
    plant = control.tf(curve["num"], curve["den"])
    dead_time = curve["dead_time_s"] + curve["sampling_delay_s"]
    w = np.geomspace(1e-3, 1e2, 40_000)
    s = 1j * w
    loop = plant(s) * np.exp(-dead_time * s) * gains["Kp"] * (1.0 + 1.0 / (gains["Ti"] * s))
    return float(np.max(1.0 / np.abs(1.0 + loop)))


def test_the_designs_have_the_Ms_asked_for_by_another_way(here: Here, job: str) -> None:
    with here.client() as client:
        found = client.get(f"/jobs/{job}/designs").json()
    assert (found["job"], found["loop"]) == (job, LOOP)
    designs = found["designs"]
    assert [each["Ms_asked"] for each in designs] == pytest.approx(np.arange(1.2, 2.001, 0.05).tolist())
    for each in designs:
        assert each["reason"] is None and 0.0 < each["uncertainty"] < 0.1
        assert peak_of_sensitivity(found, each["gains"]) == pytest.approx(each["Ms_asked"], abs=0.01)
        assert each["performance"]["Ms"] == pytest.approx(each["Ms_asked"], abs=0.01)
    # faster: a load is made good sooner, and the margins shrink
    assert np.all(np.diff([each["performance"]["load"]["IAE"] for each in designs]) < 0.0)
    assert np.all(np.diff([each["performance"]["GM"] for each in designs]) < 0.0)
    # with integral action the integral of the error after a unit load is Ti/Kp; here PV does not cross its set-point
    slow = designs[0]
    assert slow["performance"]["load"]["IAE"] == pytest.approx(slow["gains"]["Ti"] / slow["gains"]["Kp"], rel=0.02)


def test_designs_that_are_stored_with_the_earlier_name_of_the_performance_are_read(here: Here, job: str) -> None:
    with here.client() as client:
        found = client.get(f"/jobs/{job}/designs").json()["designs"][0]
    earlier = {("worth" if name == "performance" else name): value for name, value in found.items()}
    assert DesignPoint.model_validate_json(json.dumps(earlier)).model_dump(mode="json") == found


def test_the_designs_are_those_of_alternatives(here: Here, job: str) -> None:
    with here.client() as client:
        designs = client.get(f"/jobs/{job}/designs").json()
        asked = client.get(f"/jobs/{job}/alternatives?Ms=1.4").json()["methods"][0]
        proposed = client.get(f"/jobs/{job}").json()
    (point,) = [each for each in designs["designs"] if each["Ms_asked"] == 1.4]
    for name in ("Kp", "Ti", "Td"):
        assert point["gains"][name] == pytest.approx(asked["gains"][name], rel=1e-6)
    assert designs["new"]["Ms"] == pytest.approx(proposed["predicted"]["Ms"], abs=0.02)
    assert designs["previous"]["Ms"] == pytest.approx(proposed["comparison"]["previous"]["Ms"], abs=0.05)


def test_the_record_has_the_samples_and_what_the_model_leaves(here: Here, job: str) -> None:
    with here.client() as client:
        found = client.get(f"/jobs/{job}/record?points=5000").json()
        samples = client.get(f"/jobs/{job}/samples").json()
    assert found["samples"] == [1] * len(samples["t_s"]) and found["recorded"] == len(samples["t_s"])
    for name, column in (("pv_mean", "pv"), ("mv_min", "mv"), ("sp", "sp")):
        assert found[name] == pytest.approx(samples[column], abs=1e-4)
    assert np.diff(found["at_s"]) == pytest.approx(np.diff(samples["t_s"]), abs=1e-6)
    assert [each["stage"] for each in found["marks"]] == list(dict.fromkeys(samples["stage"]))
    assert found["model_from"] == "fitted" and found["noise"] == pytest.approx(0.05, rel=0.3)
    residual = np.asarray(found["explained"]["residual_mean"])
    assert residual == pytest.approx(np.subtract(found["pv_mean"], found["explained"]["model"]), abs=1e-4)
    # the plant is linear: the model leaves the noise alone
    assert np.std(residual) == pytest.approx(0.05, rel=0.15)


def test_thinning_keeps_the_extremes(here: Here, job: str) -> None:
    with here.client() as client:
        whole = client.get(f"/jobs/{job}/record?points=5000").json()
        few = client.get(f"/jobs/{job}/record?points=40").json()
        assert_problem(client.get(f"/jobs/{job}/record?points=0"), 422)
    assert len(few["at_s"]) <= 40 and sum(few["samples"]) == whole["recorded"]
    assert max(few["pv_max"]) == max(whole["pv_max"]) and min(few["mv_min"]) == min(whole["mv_min"])
    assert len({len(values) for values in few["explained"].values()} | {len(few["sp"])}) == 1


def test_the_end_of_the_job_computes_them_once_for_all_who_ask(tmp_path: Path) -> None:
    here = Here(tmp_path)
    here.pool.hold.clear()
    job = here.finished()
    assert here.store.get(job).ended_at is not None  # the end of the job did not wait for its figures
    with here.client() as client, ThreadPoolExecutor(6) as askers:
        asked = [askers.submit(client.get, f"/jobs/{job}/{what}") for what in 3 * ("record", "designs")]
        here.pool.hold.set()
        assert [each.result().status_code for each in asked] == 6 * [200]
        assert here.pool.count == 1
    # another process of the service finds them in the store
    later = Counting()
    assert KeptFigures(here.store, later).kept(job) is not None and later.count == 0
    here.figures.close()
    here.jobs.stop()
    here.store.close()


def test_who_waits_for_them_reads_other_things_meanwhile(tmp_path: Path) -> None:
    """As a page does, which asks for all three at a job's end, and for other things beside."""
    here = Here(tmp_path)
    here.pool.hold.clear()
    job = here.finished()
    shared = Mock(wraps=here.figures.asked)
    here.figures.asked = shared
    with here.client() as client, ThreadPoolExecutor(3) as askers:
        asked = [askers.submit(client.get, f"/jobs/{job}/{what}") for what in ("record", "designs", "report")]
        until(lambda: shared.called)
        for path in ("/jobs", "/loops", f"/jobs/{job}", "/session"):
            assert client.get(path).status_code == 200
        assert not any(each.done() for each in asked)
        here.pool.hold.set()
        assert [each.result().status_code for each in asked] == 3 * [200]
    here.figures.close()
    here.jobs.stop()
    here.store.close()


def test_of_an_older_job_they_are_computed_when_somebody_asks(
    here: Here, job: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with here.client() as client:
        before = client.get(f"/jobs/{job}/designs").json()
        count = here.pool.count
        monkeypatch.setattr("loopwright.service.jobs.kept_figures.VERSION", job_figures.VERSION + 1)
        assert client.get(f"/jobs/{job}/designs").json() == before and here.pool.count == count + 1
        assert client.get(f"/jobs/{job}/record").status_code == 200 and here.pool.count == count + 1


def test_the_record_goes_with_the_samples_and_the_designs_stay(tmp_path: Path) -> None:
    here = Here(tmp_path)
    first, second = here.finished(), here.finished()
    with here.client() as client:
        designs = client.get(f"/jobs/{first}/designs").json()
        here.jobs.decisions.rollback(first, "A")
        assert delete_old_samples(here.store, RetentionPolicy(jobs=1)) == 1
        told = assert_problem(client.get(f"/jobs/{first}/record"), 409)["detail"]
        assert told == f"job {first} has no record: its samples were deleted"
        assert client.get(f"/jobs/{first}").json()["record"] == "deleted"
        assert client.get(f"/jobs/{first}/designs").json() == designs
        assert client.get(f"/jobs/{second}/record").status_code == 200
        report = client.get(f"/jobs/{first}/report")
        assert report.status_code == 200 and "samples of this job were deleted" in report.text
    here.figures.close()
    here.jobs.stop()
    here.store.close()


def test_what_cannot_be_computed_or_stored_is_said_and_tried_again(
    here: Here, job: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, kept = here.store.get(job), KeptFigures(here.store, here.pool)
    monkeypatch.setattr("loopwright.service.jobs.kept_figures.VERSION", job_figures.VERSION + 2)
    limit = Mock(side_effect=Failed(Reason.COMPUTATION_LIMIT, "60 s"))
    monkeypatch.setattr(here.pool, "run", limit)
    with here.client() as client:
        assert assert_problem(client.get(f"/jobs/{job}/designs"), 422)["reason"] == "computation_limit"
        run = Mock(side_effect=[Failed(Reason.COMPUTATION_LIMIT, "60 s"), "<!doctype html>"])
        monkeypatch.setattr(here.pool, "run", run)
        assert client.get(f"/jobs/{job}/report").text == "<!doctype html>"
        (source,) = run.call_args.args[1].args
        assert "The record could not be evaluated: 60 s." in paper(source)
    monkeypatch.setattr(here.pool, "run", limit)
    kept.ended(row)  # the end of a test is not troubled by it
    with pytest.raises(Failed):
        kept.asked(row).result(60.0)
    monkeypatch.undo()
    monkeypatch.setattr("loopwright.service.jobs.kept_figures.VERSION", job_figures.VERSION + 3)
    monkeypatch.setattr("loopwright.service.store.job_figures.keep", Mock(side_effect=SQLAlchemyError("no room")))
    assert kept.asked(row).result(60.0).designs is not None
    assert kept.kept(job) is None
    kept.close()
    monkeypatch.setattr(here.pool, "run", Mock(side_effect=NotWanted()))
    with here.client() as client:
        assert assert_problem(client.get(f"/jobs/{job}/record"), 503)["reason"] == "service_stopped"


class Endless(Counting):
    """A pool whose computations last until nobody wants them."""

    def __init__(self) -> None:
        super().__init__()
        self.begun = threading.Event()

    def run(self, kind: ComputationKind, work: Any, *, unwanted: Callable[[], bool] = lambda: False, **_: Any) -> Any:
        self.begun.set()
        until(unwanted)
        raise NotWanted


def test_who_waits_as_the_service_is_to_end_gets_an_answer(
    here: Here, job: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The server would cancel the request after its grace, and log that as an error of the application."""
    monkeypatch.setattr("loopwright.service.jobs.kept_figures.VERSION", job_figures.VERSION + 4)
    pool = Endless()
    figures = KeptFigures(here.store, pool)
    app = app_of(here.jobs, pool=pool, figures=figures)
    with TestClient(app) as client, ThreadPoolExecutor(2) as askers:
        asked = [askers.submit(client.get, f"/jobs/{job}/{what}") for what in ("record", "designs")]
        assert pool.begun.wait(60.0)
        figures.request_stop()
        for each in asked:
            assert assert_problem(each.result(60.0), 503)["reason"] == "service_stopped"
    figures.close()
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []


def test_a_defect_in_a_fit_takes_neither_the_record_nor_the_job(
    here: Here, job: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, events = here.store.get(job), here.store.events(job)
    blocks = list(here.store.blocks(job))
    monkeypatch.setattr(job_figures, "evaluate_again", Mock(side_effect=ZeroDivisionError))
    found = job_figures.job_figures(row, events, blocks)
    assert found.record is not None and found.record.facts.model_from == "driven"
    assert found.designs is not None and found.designs.designed_on == "the job's model"
    # the model driven by MV leaves hardly more than the one that was fitted to the record
    assert found.record.explained is not None
    assert np.std(found.record.explained["mv_mean"]) == pytest.approx(0.05, rel=0.3)
    monkeypatch.setattr(job_figures, "design_curve", Mock(side_effect=ValueError))
    found = job_figures.job_figures(row, events, blocks)
    assert found.record is not None and found.designs is None


@pytest.mark.parametrize(
    "model",
    [
        FOPDT(2.0, 6.0, 1.5),
        Integrating(0.3, 0.8),
        TransferFunction((1.0, 3.0), (4.0, 5.0, 1.0), 0.0),
        TransferFunction((0.5, 1.0), (2.0, 1.0), 1.0),  # bi-proper: MV goes through at once
    ],
)
def test_a_driven_model_is_that_of_scipy_at_the_samples(model: Model) -> None:
    Ts, count = 0.1, 400
    mv = 50.0 + np.repeat(np.random.default_rng(3).normal(size=count // 20), 20)
    system = cont2discrete(tf2ss(model.num, model.den), Ts, "zoh")
    _, answer, _ = dlsim(system, mv - mv[0])
    delay = round(model.L / Ts)
    expected = np.concatenate((np.zeros(delay), np.ravel(answer)))[:count] + 20.0
    nothing = np.zeros(count)
    attempt = Attempt(Ts, np.arange(count), nothing, expected, mv, nothing, np.full(count, "relay"))
    assert driven(model, attempt) == pytest.approx(expected, abs=1e-9)


def test_missing_samples_are_a_gap_and_no_line(here: Here, job: str) -> None:
    columns = record_columns(here.store.blocks(job))
    kept = [n for n in range(len(columns["t_s"])) if not 100 <= n < 130]
    attempt = last_attempt({name: [values[n] for n in kept] for name, values in columns.items()})
    assert attempt is not None
    bins = job_record(attempt, None, None, (), None).measured
    assert len(bins) == len(kept) and np.flatnonzero(bins["gap"]).tolist() == [100]
    assert unpack(job_record(attempt, None, None, (), 0.1).pack()).measured.tolist() == bins.tolist()


def test_a_job_of_five_stages_has_the_designs_of_its_model(service: Service, client: TestClient) -> None:
    job = finished(service, client)
    found = client.get(f"{job['url']}/designs").json()
    assert found["designed_on"] == "the job's model" and len(found["designs"]) == 17
    for each in found["designs"]:
        assert each["uncertainty"] is None
        assert peak_of_sensitivity(found, each["gains"]) == pytest.approx(each["Ms_asked"], abs=0.01)


def test_a_job_without_them_says_why(service: Service, client: TestClient) -> None:
    assert_problem(client.get("/jobs/none/record"), 404)
    assert_problem(client.get("/jobs/none/designs"), 404)
    rehearsed = finished(service, client, dry_run=True)["id"]
    told = assert_problem(client.get(f"/jobs/{rehearsed}/record"), 409)["detail"]
    assert told == f"job {rehearsed} has no record: it ended as rehearsed before its second sample"
    assert client.get(f"/jobs/{rehearsed}").json()["record"] == "none"
    service.tune.hold.clear()
    running = start(client)
    assert service.tune.inside.wait(20.0)
    for what in ("record", "designs", "report"):
        assert "is not over" in assert_problem(client.get(f"/jobs/{running}/{what}"), 409)["detail"]
    assert client.get(f"/jobs/{running}").json()["record"] == "none"
    client.post(f"/jobs/{running}/abort")
    service.wait(running)
    assert client.get(f"/jobs/{running}/record").status_code == 200
    listed = {each["id"]: each["record"] for each in client.get("/jobs").json()}
    assert listed == {rehearsed: "none", running: "kept"}
    told = assert_problem(client.get(f"/jobs/{running}/designs"), 409)["detail"]
    assert told == f"job {running} ended as aborted before it had a model to compare methods on; the job says why"
