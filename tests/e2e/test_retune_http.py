"""A live loop retuned through HTTP as an operator would."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from loopwright.plantsim.catalogue import find
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.models import TransferFunction
from tests.e2e.plantsite import MODEL_14, MODEL_41, REACTOR, SOPDT, Case, Plantsite

METHODS = ("fast", "setpoint", "five-stage")
RUNS = {f"{case.model} {method}": (case, method) for case in (MODEL_14, MODEL_41) for method in METHODS}


@pytest.fixture
def site(bus: str, tmp_path: Path) -> Iterator[Callable[[Case], Plantsite]]:
    with ExitStack() as stack:
        yield lambda case: Plantsite(stack, tmp_path, case, bus)


def sampled_ultimate_point(case: Case) -> tuple[float, float]:
    """Ku in percent per PV unit and Pu in s of the sampled loop, which P control finds: half a sample is dead time."""
    model, facts = find(case.model).model, find(case.model).facts
    assert model is not None
    gain, period = ultimate_point(TransferFunction(model.num, model.den, model.dead_time_s + 0.5 * case.ts))
    return gain * facts.mv_per_unit, period


@pytest.mark.on_vcan("model-14 five-stage", "model-41 fast")
@pytest.mark.parametrize("run", RUNS)
def test_a_live_loop_is_retuned_and_the_change_taken_back(site: Callable[[Case], Plantsite], run: str) -> None:
    case, method = RUNS[run]
    here = site(case)
    url = here.retune(**({} if method == "fast" else {"method": method}))
    job = here.finished(url)
    assert (job["state"], job["method"]) == ("proposed", method), (job["reason"], job["detail"])
    Ku, Pu_s = sampled_ultimate_point(case) if method == "five-stage" else (case.Ku, case.Pu_s)
    assert job["ultimate"]["Ku"] == pytest.approx(Ku, rel=0.015)
    assert job["ultimate"]["Pu_s"] == pytest.approx(Pu_s, rel=0.02)
    assert job["predicted"]["Ms"] <= 2.0
    if method != "five-stage":
        assert job["predicted"]["Ms"] == pytest.approx(1.6, abs=0.02) and job["evidence"]["uncertainty"] < 0.1
        assert job["verification"]["fit_pct"] > 95 and job["predicted_previous"]
        assert job["plant_time_s"] < 12 * case.Pu_s + case.t95_s
    assert job["previous_gains"]["Kp"] == pytest.approx(case.kp) and job["restored"]["mode"] == "automatic"
    assert here.is_home()
    samples = here.http.get(f"{url}/samples?stage=verify").json()
    assert len(samples["t_s"]) > 100 and set(samples["stage"]) == {"verify"}
    accepted = here.http.post(f"{url}/accept").json()
    assert accepted["state"] == "accepted"
    assert here.state().gains.Kp == pytest.approx(job["new_gains"]["Kp"], rel=1e-6)
    here.controller.kill()
    here.start_controller()
    here.controller.wait_ready()
    assert here.state().gains.Kp == pytest.approx(job["new_gains"]["Kp"], rel=1e-6)
    assert here.http.post(f"{url}/rollback").json()["state"] == "rolled_back"
    assert here.is_home()


@pytest.mark.on_vcan("imc-pid")
@pytest.mark.parametrize("method", ["imc-pid", "direct-synthesis"])
def test_another_method_on_a_model_of_the_jobs_own_samples(method: str, site: Callable[[Case], Plantsite]) -> None:
    here = site(SOPDT)
    url = here.retune(method=method)
    job = here.finished(url)
    assert job["state"] == "proposed", (job["reason"], job["detail"])
    model = job["model"]
    # 2 exp(-s) / (50 s^2 + 15 s + 1), a percent being a hundredth of its unit; a sampled loop has half a sample more
    assert model["k_source"] == "record" and model["fit_pct"] > 99
    assert model["K"] == pytest.approx(0.02, rel=0.01)
    assert model["T_s"] == pytest.approx(50**0.5, rel=0.02)
    assert model["zeta"] == pytest.approx(7.5 / 50**0.5, rel=0.02)
    assert model["L_s"] == pytest.approx(1.0, abs=0.05)
    gains = job["new_gains"]
    assert gains["Td"] > 0 and gains["Tf"] > 0
    assert job["predicted"]["Ms"] < 2
    assert job["step_after"]["settled"] and job["step_after"]["IAE"] < job["step_before"]["IAE"]
    assert here.is_home()


def test_the_reactor_gets_the_optimum_of_the_paper(site: Callable[[Case], Plantsite]) -> None:
    here = site(REACTOR)
    options: dict[str, Any] = {"overshoot_window_pct": [8, 50], "kp_step_factor": 1.5, "mv_low": 40, "mv_high": 60}
    job = here.finished(here.retune(method="five-stage", **options))
    assert job["state"] == "proposed", (job["reason"], job["detail"])
    assert job["ultimate"]["Ku"] == pytest.approx(REACTOR.Ku, rel=0.015)
    assert job["ultimate"]["Pu_s"] == pytest.approx(REACTOR.Pu_s, rel=0.02)
    assert job["new_gains"]["Kp"] == pytest.approx(0.75, rel=0.05)
    assert job["new_gains"]["Ti"] == pytest.approx(19.17, rel=0.05)
    assert here.is_home()
