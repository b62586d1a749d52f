"""A fast job through the service: a step of the load in the middle of its relay is found, told and allowed for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.rehearsed import MIDDLE, TS, entry
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.api.job_views import job_view
from loopwright.service.execution.procedures import rehearse, tune
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.inputs.config import LoopConfig, parse_site
from loopwright.service.inputs.request import retune_request
from loopwright.service.jobs.stored_record import record_columns
from loopwright.service.results import GainsView
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.store import Store
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from loopwright.tuning.plan import Mode
from tests.unit.service.fakes import ThreadEngine

TAG = "TIC-1"
K, T, L = 2.0, 6.0, 1.5
NOISE = 0.3
AMPLITUDE = 20.0


class Loaded:
    """The plant of a loop whose load steps by so many percent of MV at a time, s."""

    def __init__(self, size: float, at_s: float) -> None:
        self._plant = LinearPlant([K], [T, 1.0], L, TS, noise_std=NOISE, seed=3)
        self._size, self._at, self._n = size, round(at_s / TS), 0

    @property
    def pv(self) -> float:
        return self._plant.pv

    def step(self, mv: float) -> float:
        self._n += 1
        return self._plant.step(mv - MIDDLE + (self._size if self._n > self._at else 0.0))


def proposal(folder: Path, size: float, at_s: float, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """The job as the API shows it, and its samples."""

    def open_loop(_: LoopConfig) -> RehearsedLoop:
        settings = Settings(mv_low=0.0, mv_high=100.0, safe_output=MIDDLE, pv_low=-200.0, pv_high=200.0, reverse=True)
        channel = Channel(TS, settings, Parameters(0.2, 6.0), 0.0, int(Mode.AUTOMATIC), MIDDLE)
        return RehearsedLoop(Loaded(size, at_s), channel, TS)

    loops = parse_site({"loops": [entry(TAG) | {"sp_deviation": 5.0}]}, "test").loops
    store, engine = Store(folder), ThreadEngine()
    jobs = make_jobs(loops, store, open_loop, tune, rehearse, engine=engine)
    jobs.boot()
    asked = {name: value for name, value in {"amplitude_pct": AMPLITUDE, **options}.items() if value is not None}
    row = jobs.start(TAG, retune_request(**asked))
    engine.join(100)
    jobs.stop()
    job = job_view(store.get(row.id), store.events(row.id), None).model_dump(mode="json")
    samples = {name: list(column) for name, column in record_columns(store.blocks(row.id)).items()}
    store.close()
    return job, samples


@pytest.mark.parametrize("size", [6.0, -8.0])
def test_a_load_step_in_mid_relay_is_found(tmp_path: Path, size: float) -> None:
    at_s = 12.3 + 7.0  # the relay begins 12.2 s after the start: 120 samples at rest
    job, samples = proposal(tmp_path, size, at_s)
    assert job["state"] == "proposed", job["detail"]
    relay = samples["t_s"][samples["mode"].index(int(Mode.EXPERIMENT))]
    (load,) = job["evidence"]["loads"]
    true_t = at_s - relay
    assert 4.0 < true_t < 9.0  # within the relay, after its first wave
    assert load["t_s"] == pytest.approx(true_t, rel=0.1)
    assert load["size"] == pytest.approx(size, rel=0.1)
    assert any("A load disturbance" in note for note in job["notes"])
    gains = Gains(job["new_gains"]["Kp"], job["new_gains"]["Ti"])
    assert margins(FOPDT(K, T, L + TS / 2), gains).Ms == pytest.approx(1.6, abs=0.1)


def test_without_a_load_none_is_found(tmp_path: Path) -> None:
    job, _ = proposal(tmp_path, 0.0, 0.0, Ms=1.4)
    assert job["state"] == "proposed", job["detail"]
    assert job["evidence"]["loads"] == [] and not job["evidence"]["drift"]
    gains = Gains(job["new_gains"]["Kp"], job["new_gains"]["Ti"])
    assert margins(FOPDT(K, T, L + TS / 2), gains).Ms == pytest.approx(1.4, abs=0.05)


def test_gains_for_another_Ms_are_tried_without_another_relay(tmp_path: Path) -> None:
    model = {"num": [K], "den": [T, 1.0], "dead_time_s": L}
    job, samples = proposal(tmp_path, 0.0, 0.0, amplitude_pct=None, start="design", model=model, Ms=1.4)
    assert job["state"] == "proposed", job["detail"]
    assert int(Mode.EXPERIMENT) not in samples["mode"]
    assert [stage["stage"] for stage in job["stages"]] == ["preflight", "design", "verify"]
    gains = Gains(job["new_gains"]["Kp"], job["new_gains"]["Ti"])
    assert margins(FOPDT(K, T, L + TS / 2), gains).Ms == pytest.approx(1.4, abs=0.01)
    assert job["step_after"]["settled"] and job["step_after"]["overshoot_pct"] < 40
    assert job["predicted_previous"] and job["evidence"] is None and job["step_before"] is None
    assert job["restored"]["gains"]["Kp"] == pytest.approx(0.2) and job["restored"]["on_trial"] is False


def test_a_job_with_a_settling_time_and_a_movement_of_MV(tmp_path: Path) -> None:
    """With what was asked for and what is reached in the job; what is refused names what is possible."""
    asked = {"settling_s": 14.0, "mv_peak": 1.5}
    job, _ = proposal(tmp_path, 0.0, 0.0, **asked)
    assert job["state"] == "proposed" and job["request"]["settling_s"] == 14.0 and job["request"]["mv_peak"] == 1.5
    compared, reached = job["comparison"], job["comparison"]["new"]["setpoint"]
    assert (compared["settling_s_asked"], compared["mv_peak_asked"]) == (14.0, 1.5)
    assert reached["settling_s"] <= 14.0014 and reached["mv_peak"] <= 1.50015
    assert job["design"]["Ms"] < 1.55 and job["design"]["settling_s"] == 14.0
    gains = GainsView.model_validate(job["new_gains"]).gains()
    assert margins(FOPDT(K, T, L + 0.5 * TS), gains).Ms == pytest.approx(job["design"]["Ms"], abs=0.05)
    never, _ = proposal(tmp_path / "never", 0.0, 0.0, settling_s=3.0)
    assert (never["state"], never["reason"]) == ("refused", "not_possible")
    assert "3 s was asked for: ask for at least" in never["detail"] and never["advice"]
