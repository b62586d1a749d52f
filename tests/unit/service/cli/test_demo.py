"""The demo: its loop in memory, retuned by each method, and the table against a simulation of its own."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from fastapi.testclient import TestClient
from rich.console import Console

from loopwright.containers import demo as container_demo
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.catalogue import find
from loopwright.service.api.app import create_app
from loopwright.service.api.job_views import JobView
from loopwright.service.cli import demo, job_tables
from loopwright.service.cli.client import Client
from loopwright.service.cli.demo_report import METHODS, PLANT, PLANT_MODEL, demonstrate, report
from loopwright.service.execution.procedures import tune
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.inputs.config import parse_site
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.store import Store
from loopwright.tuning.plan import Mode
from tests.unit.service.cli.test_cli_jobs import Through, run
from tests.unit.service.fakes import TAG, Service, ThreadEngine, fake_rehearse

TS = demo.SAMPLE_TIME_S
KP, TI = map(float, demo.BAD_GAINS)


@pytest.fixture
def through(client: TestClient) -> Through:
    return Through(client)


@pytest.fixture
def in_memory(tmp_path: Path) -> Iterator[Through]:
    """A service that has the demo's loop, in memory: time stands still between two retunes."""
    settings = Settings(0.0, 100.0, safe_output=0.0, pv_low=-1e9, pv_high=1e9, reverse=True)
    channel = Channel(TS, settings, Parameters(KP, TI), 50.0, int(Mode.AUTOMATIC), 50.0)
    loop = RehearsedLoop(find(PLANT).build(TS, float(demo.NOISE), seed=1), channel, TS)
    loops = parse_site(yaml.safe_load(demo.loops_yaml("virtual:demo")), "demo").loops
    store = Store(tmp_path)
    jobs = make_jobs(loops, store, lambda config: loop, tune, fake_rehearse, engine=ThreadEngine())
    jobs.boot()
    with TestClient(create_app(jobs)) as http:
        yield Through(http)
    jobs.stop()
    store.close()


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    text = io.StringIO()
    monkeypatch.setattr(job_tables, "console", Console(file=text, width=160))
    return text


def lines(text: str) -> dict[str, list[str]]:
    """The lines of all tables, by their first cell."""
    cells = [[cell.strip() for cell in line.strip("│┃").split("│")] for line in text.splitlines() if "│" in line]
    return {first: rest for first, *rest in cells}


def simulated(kp: float, ti: float) -> tuple[float, float, float]:
    """Overshoot in % and IAE of a unit set-point step, IAE of a unit load, by the plant process's own plant."""
    IAE, peak = [], 0.0
    # a tenth of the step, for which MV stays within its limits
    for step, load in ((0.1, 0.0), (0.0, 1.0)):
        plant, integral, pv, error_sum = find(PLANT).build(TS), 0.0, 50.0, 0.0
        for _ in range(4000):
            error = 50.0 + step - pv
            error_sum += TS * abs(error)
            peak = max(peak, -error / step) if step else peak
            integral += kp / ti * TS * error
            pv = plant.step(50.0 + kp * error + integral + load)
        IAE.append(error_sum / (step or load))
    return 100.0 * peak, IAE[0], IAE[1]


def sensitivity(kp: float, ti: float) -> float:
    """Ms of the loop with model 14 as the catalogue prints it, in % of MV, and half a sample of delay."""
    s = 1j * np.geomspace(1e-2, 1e2, 20_001)
    entry = find(PLANT).model
    assert entry is not None
    plant = np.polyval(entry.num, s) / np.polyval(entry.den, s) / 100.0 * np.exp(-s * (entry.dead_time_s + 0.5 * TS))
    return float(np.abs(1.0 / (1.0 + kp * (1.0 + 1.0 / (ti * s)) * plant)).max())


def test_each_method_retunes_the_same_loop_and_the_table_is_of_the_plant(
    in_memory: Through, screen: io.StringIO
) -> None:
    shown = demonstrate(in_memory, demo.TAG, METHODS)
    report(in_memory, demo.TAG, shown, PLANT_MODEL)
    assert not shown.without_proposal
    assert [job.method for job in shown.jobs] == ["five-stage", "fast", "setpoint"]
    assert {(job.old_gains.Kp, job.old_gains.Ti) for job in shown.jobs if job.old_gains} == {(KP, TI)}
    table = lines(screen.getvalue())
    Ku = [float(table[stage][1].split("Ku ")[1].removeprefix("about ").split(",")[0]) for stage in list(table)[:2]]
    assert Ku[0] == pytest.approx(205, rel=0.1) and Ku[1] == pytest.approx(205, rel=0.015)
    assert list(table)[:5] == [
        "1 relay", "2 Ku by P control", "3 Ziegler-Nichols PI", "4 FOPDT from overshoot", "5 robust optimisation",
    ]  # fmt: skip
    assert table["5 robust optimisation"][1] == f"Kp {table['Kp'][1]}, Ti {table['Ti'][1]} s"
    assert table["ended as"][1:4] == ["proposed"] * 3
    assert [float(each) for each in table["plant time"][1:4]] == [round(job.plant_time_s, 1) for job in shown.jobs]
    assert float(table["plant time"][2]) < float(table["plant time"][1]) / 4
    assert (table["Kp"][0], table["Ti"][0]) == ("80", "1.2")
    for column in range(4):
        kp, ti = float(table["Kp"][column]), float(table["Ti"][column])
        overshoot, of_setpoint, of_load = simulated(kp, ti)
        assert float(table["Ms"][column]) == pytest.approx(sensitivity(kp, ti), abs=0.003)
        assert float(table["overshoot"][column]) == pytest.approx(overshoot, abs=1.0)
        assert float(table["IAE, set-point"][column]) == pytest.approx(of_setpoint, rel=0.02)
        assert float(table["IAE, load"][column]) == pytest.approx(of_load, rel=0.02)
    assert "automatic, Kp 80, Ti 1.2, set-point 50" in screen.getvalue()


def test_one_method_alone_has_its_whole_report_too(in_memory: Through, screen: io.StringIO) -> None:
    shown = demonstrate(in_memory, demo.TAG, ["setpoint"])
    report(in_memory, demo.TAG, shown, None)
    assert [body["method"] for body in in_memory.posted] == ["setpoint"]
    table = lines(screen.getvalue())
    assert "fit of measured step" in table and "1 relay" not in table
    assert "IAE, set-point" not in table, "the figures on a plant that is not known"


def test_a_retune_that_is_on_its_way_is_followed_instead_of_starting_others(
    service: Service, through: Through, screen: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.tune.hold.clear()
    begun = through.post(f"/loops/{TAG}/retune", {"method": "fast"})
    assert service.tune.inside.wait(20)
    follow = job_tables.follow

    def as_it_ends(client: Client, job_url: str) -> JobView:
        service.tune.hold.set()
        return follow(client, job_url)

    monkeypatch.setattr(job_tables, "follow", as_it_ends)
    shown = demonstrate(through, TAG, METHODS)
    assert [job.id for job in shown.jobs] == [begun["id"]] and len(through.posted) == 1


def test_the_plant_of_the_table_is_the_simulated_one() -> None:
    model = find(PLANT).model
    assert model is not None
    per_unit = find(PLANT).facts.mv_per_unit
    assert PLANT_MODEL.num == pytest.approx([each / per_unit for each in model.num])
    assert (PLANT_MODEL.den, PLANT_MODEL.L) == (model.den, model.dead_time_s)


@pytest.mark.parametrize("bad", ["fats", "simc", ""])
def test_a_bad_method_is_refused_before_anything_starts(
    bad: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo, "run_demo", lambda *_: pytest.fail("it was started"))
    monkeypatch.setattr(container_demo, "_demonstrate", lambda *_: pytest.fail("it was started"))
    result = run("demo", "--method", bad)
    with pytest.raises(SystemExit, match="2"):
        container_demo.main(["--method", bad])
    said = capsys.readouterr().err
    assert result.exit_code == 2
    for method in METHODS:
        assert method in result.output and method in said
