"""The demo: its loop in memory, retuned by each method, and the table against a simulation of its own."""

from __future__ import annotations

import io
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from fastapi.testclient import TestClient
from rich.console import Console

from loopwright.containers import demo as container_demo
from loopwright.containers import keeper
from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.catalogue import find
from loopwright.service.api.job_views import JobView
from loopwright.service.cli import demo, demo_live, job_tables, terminal
from loopwright.service.cli import main as cli
from loopwright.service.cli.client import Client
from loopwright.service.cli.demo_report import METHODS, PLANT, PLANT_MODEL, demonstrate, report
from loopwright.service.execution.procedures import tune
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.inputs.config import parse_site
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.store import Store
from loopwright.tuning.plan import Mode
from tests.unit.service.apps import app_of
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
    with TestClient(app_of(jobs)) as http:
        yield Through(http)
    jobs.stop()
    store.close()


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    text = io.StringIO()
    monkeypatch.setattr(terminal, "console", Console(file=text, width=160))
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
    assert {(job.previous_gains.Kp, job.previous_gains.Ti) for job in shown.jobs if job.previous_gains} == {(KP, TI)}
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
    begun = through.post(f"/loops/{TAG}/retune", {"by": "me", "method": "fast"})
    assert service.tune.inside.wait(20)
    follow = job_tables.follow

    def as_it_ends(client: Client, job_url: str, to: Console) -> JobView:
        service.tune.hold.set()
        return follow(client, job_url, to)

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


TERMINAL, NO_TERMINAL = (lambda: True), (lambda: False)


@pytest.mark.parametrize(
    ("keyboard", "screen_is", "more", "goes_on"),
    [
        (TERMINAL, TERMINAL, (), True),
        (TERMINAL, TERMINAL, ("--once",), False),
        (TERMINAL, NO_TERMINAL, (), False),
        (NO_TERMINAL, TERMINAL, (), False),
    ],
)
def test_it_goes_on_in_a_terminal_alone_and_not_with_once(
    keyboard: Callable[[], bool],
    screen_is: Callable[[], bool],
    more: tuple[str, ...],
    goes_on: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started: list[demo.DemoOptions] = []
    monkeypatch.setattr(demo, "run_demo", started.append)
    monkeypatch.setattr(cli, "on_terminal", keyboard)
    monkeypatch.setattr(cli, "shown_on_terminal", screen_is)
    assert run("demo", *more).exit_code == 0
    assert [each.goes_on for each in started] == [goes_on]


def test_the_port_of_the_page_is_said_where_it_is_another(screen: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server((demo.ADDRESS, 0)) as taken:
        monkeypatch.setattr(demo, "PAGE_PORT", taken.getsockname()[1])
        assert demo.port_of(demo.DemoOptions(goes_on=True)) == 0
        assert f"port {demo.PAGE_PORT} of 127.0.0.1" in screen.getvalue()
        with pytest.raises(demo.DemoFailed, match="--port"):
            demo.port_of(demo.DemoOptions(port=demo.PAGE_PORT))
    assert demo.port_of(demo.DemoOptions(goes_on=True)) == demo.PAGE_PORT
    assert demo.port_of(demo.DemoOptions()) == 0


def test_the_command_that_accepts_is_the_one_that_was_typed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "loopwright"
    program.touch(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["./loopwright", "demo"])
    monkeypatch.setenv("PATH", "/nowhere")
    assert demo_live.accept_command("http://127.0.0.1:8080", "ab12") == ["./loopwright", "job", "ab12", "--accept"]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert demo_live.accept_command("http://127.0.0.1:9", "ab12") == [
        "loopwright", "job", "ab12", "--accept", "--url", "http://127.0.0.1:9"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("options", "speed", "paces"),
    [((), "max", [0.0, 1.0]), (("--once",), "max", [0.0]), ((), "5", [])],
)
def test_in_containers_it_ends_and_leaves_the_plant_in_real_time_with_the_page_named(
    options: tuple[str, ...],
    speed: str,
    paces: list[float],
    in_memory: Through,
    screen: io.StringIO,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found: list[float] = []
    monkeypatch.setenv("LOOPWRIGHT_SPEED", speed)
    monkeypatch.setenv("LOOPWRIGHT_PORT", "8123")
    monkeypatch.setattr(container_demo, "Client", lambda url: in_memory)
    monkeypatch.setattr(in_memory, "pages", in_memory.get, raising=False)
    monkeypatch.setattr(keeper, "join", lambda patience_s: ("virtual:demo", socket.socket()))
    monkeypatch.setattr(demo_live, "set_pace", lambda bus, pace: found.append(pace))
    assert container_demo.main(["--method", "fast", *options]) == 0
    said = capsys.readouterr().out
    job = JobView.model_validate(in_memory.get("/jobs")[0])
    assert found == paces
    named = ("http://127.0.0.1:8123/ui/loops/TIC-101", f"docker compose exec service loopwright job {job.id} --accept")
    assert all((each in said) is not bool(options) for each in named)
