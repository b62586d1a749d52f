"""`loopwright retune`, `job`, `alternatives` and `rehearse`: the options of fast, the picture, another Ms."""

from __future__ import annotations

import errno
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner, Result

from loopwright.service.cli import jobs, loops, terminal
from loopwright.service.cli import main as cli
from loopwright.service.cli.client import ApiError, Client, ServiceAway
from loopwright.service.cli.plots import job as job_plot
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import NoGain, Reason, Refused
from tests.unit.service.fakes import TAG, FakeLoop, Service

PLANT = {"num": [1.0], "den": [8.0, 6.0, 1.0], "dead_time_s": 1.0, "noise_std": 0.002, "sample_time_s": 0.1}


class Through:
    """The command line's client, on the service of the test."""

    url = "http://service.of.the.test"

    def __init__(self, client: TestClient) -> None:
        self._client = client
        self.posted: list[dict[str, Any]] = []
        self.paths: list[str] = []

    def get(self, path: str, **query: Any) -> Any:
        return self._checked(self._client.get(path, params={k: v for k, v in query.items() if v is not None}))

    computed = awaited = get
    samples_of = Client.samples_of
    pages = Client.pages
    file = Client.file

    def _answer(self, method: str, path: str, patience_s: float = 0.0) -> Any:
        answer = self._client.request(method, path)
        if not answer.is_success:
            raise ApiError(answer.text)
        return answer

    def post(self, path: str, body: dict[str, Any] | None = None) -> Any:
        self.posted.append(body or {})
        self.paths.append(path)
        return self._checked(self._client.post(path, json=body or {}))

    def events(self, path: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Ends with the job, as the stream does."""
        while self.get(path)["state"] in ("queued", "running"):
            time.sleep(0.005)
        yield from ()

    @staticmethod
    def _checked(answer: Any) -> Any:
        assert answer.status_code < 300, answer.text
        return answer.json()


@pytest.fixture
def through(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> Through:
    through = Through(client)
    for module in (cli, jobs, loops):
        monkeypatch.setattr(module, "Client", lambda _url: through)
    return through


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli.app, list(arguments))


def test_the_options_of_fast_are_asked_for(service: Service, through: Through) -> None:
    options = (
        "--ms",
        "1.4",
        "--derivative",
        "--aim",
        "no_overshoot",
        "--settling-s",
        "300",
        "--mv-peak",
        "4",
        "--noise-gain",
        "2",
        "--amplitude",
        "10",
        "--min-switches",
        "6",
        "--no-verify",
        "--no-wait",
        "--json",
        "--yes",
    )
    result = run("retune", TAG, *options)
    assert result.exit_code == 0, result.output
    (body,) = through.posted
    assert body == {
        "Ms": 1.4, "derivative": True, "aim": "no_overshoot", "settling_s": 300.0, "mv_peak": 4.0, "noise_gain": 2.0,
        "amplitude_pct": 10.0, "min_switches": 6, "verify": False, "by": "cli",
    }  # fmt: skip
    job = json.loads(result.stdout)
    service.wait(job["id"])
    assert job["method"] == "fast" and job["request"]["Ms"] == 1.4 and job["request"]["aim"] == "no_overshoot"


def test_to_where_and_how_fast_the_set_point_may_move_is_asked_for(service: Service, through: Through) -> None:
    result = run("retune", TAG, "--method", "setpoint", "--directions", "down", "--sp-rate-max-per-s", "0.5",
                 "--no-wait", "--json", "--yes")  # fmt: skip
    assert result.exit_code == 0, result.output
    (body,) = through.posted
    assert body == {"method": "setpoint", "directions": "down", "sp_rate_max_per_s": 0.5, "by": "cli"}
    service.wait(json.loads(result.stdout)["id"])


def test_a_proposal_all_the_same_is_asked_for(service: Service, through: Through) -> None:
    result = run("retune", TAG, "--propose-anyway", "--no-wait", "--json", "--yes")
    assert through.posted == [{"propose_anyway": True, "by": "cli"}]
    service.wait(json.loads(result.stdout)["id"])


def test_a_dry_run_does_not_call_itself_a_proposal(service: Service, through: Through) -> None:
    result = run("retune", TAG, "--dry-run")
    assert result.exit_code == 0, result.output
    assert "rehearsed, nothing was tested" in result.output and "proposed" not in result.output


def test_no_gain_is_a_good_end(service: Service, through: Through) -> None:
    service.tune.ends = NoGain(Reason.NO_GAIN, "Nothing asked for gets better by more than 5 %")
    result = run("retune", TAG, "--yes")
    assert result.exit_code == 0, result.output
    assert "no_gain: the loop is already tuned as well as asked" in " ".join(result.output.split())
    service.tune.ends = Refused(Reason.NOT_AT_REST, "drifts")
    assert run("retune", TAG, "--yes").exit_code == 3


def test_five_stage_is_asked_for_by_its_name(service: Service, through: Through) -> None:
    result = run("retune", TAG, "--method", "five-stage", "--no-wait", "--json", "--yes")
    assert result.exit_code == 0 and json.loads(result.stdout)["method"] == "five-stage"
    service.wait(json.loads(result.stdout)["id"])


def on_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "on_terminal", lambda: True)


def test_not_on_a_terminal_a_retune_is_not_started_without_yes(service: Service, through: Through) -> None:
    result = run("retune", TAG)
    assert result.exit_code == 2 and "--preview" in result.output and "--yes" in result.output
    assert through.paths == [] and service.store.recent() == []


@pytest.mark.parametrize(("answer", "status", "jobs"), [("y\n", 0, 1), ("n\n", 1, 0), ("\n", 1, 0)])
def test_on_a_terminal_a_retune_says_what_it_does_and_asks(
    service: Service, through: Through, monkeypatch: pytest.MonkeyPatch, answer: str, status: int, jobs: int
) -> None:
    on_terminal(monkeypatch)
    result = CliRunner().invoke(cli.app, ["retune", TAG, "--no-wait", "--json", "--ms", "1.4"], input=answer)
    assert result.exit_code == status, result.output
    assert "moves MV by" in result.stderr and "of plant time" in result.stderr and "Start?" in result.stderr
    rows = service.store.recent()
    assert len(rows) == jobs
    if jobs:
        assert through.posted[0] == through.posted[1]
        report = result.stdout[result.stdout.index("{") :]  # before it, the answer as the runner echoes it
        assert json.loads(report)["request"]["Ms"] == 1.4
        service.wait(rows[0].id)


def test_a_preview_alone_prints_and_ends(service: Service, through: Through) -> None:
    result = run("retune", TAG, "--preview")
    assert result.exit_code == 0 and "moves MV by" in result.stdout
    shown = run("retune", TAG, "--preview", "--json", "--method", "five-stage")
    assert json.loads(shown.stdout)["method"] == "five-stage"
    assert service.store.recent() == [] and set(through.paths) == {f"/loops/{TAG}/retune/preview"}
    service.controller.state = replace(service.controller.state, mode=Mode.MANUAL)
    refused = run("retune", TAG, "--preview")
    assert refused.exit_code == 3 and "would be refused now" in refused.stdout and "wrong_mode" in refused.stdout


def test_a_tag_with_a_wildcard_is_a_retune_of_many(service: Service, through: Through) -> None:
    assert run("retune", "*").exit_code == 2
    assert through.paths == []
    result = run("retune", "*", "--preview")
    assert result.exit_code == 0, result.output
    assert "2 loops are retuned by fast" in result.stdout
    begun = run("retune", "TIC-*", "--yes", "--json")
    assert begun.exit_code == 0, begun.output
    assert [each["loop"] for each in json.loads(begun.stdout)["loops"]] == [TAG]


@pytest.fixture
def rehearsed(service: Service, through: Through) -> str:
    """The id of a job that has rehearsed."""
    from loopwright.service.execution.procedures import rehearse

    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearse)
    from loopwright.service.inputs.request import PlantModel, retune_request

    row = jobs.start(TAG, retune_request(dry_run=True, plant=PlantModel(**PLANT)))
    service.wait(row.id)
    jobs.stop()
    assert service.store.get(row.id).state == "rehearsed", service.store.get(row.id).detail
    return row.id


def test_a_job_and_its_picture_and_another_Ms(rehearsed: str, tmp_path: Path) -> None:
    picture = tmp_path / "job.png"
    shown = run("job", rehearsed, "--plot", str(picture))
    assert shown.exit_code == 0, shown.output
    assert picture.stat().st_size > 20_000
    for words in ("predicted overshoot", "model K", "uncertainty of Ms", "fit of measured step"):
        assert words in shown.output
    found = run("alternatives", rehearsed, "--ms", "1.4", "--json")
    (fast,) = json.loads(found.stdout)["methods"]
    assert fast["retune"]["start"] == "design" and fast["retune"]["Ms"] == 1.4 and fast["uncertainty"] < 0.1
    told = run("alternatives", rehearsed, "--ms", "1.4")
    assert told.exit_code == 0 and '"start": "design"' in told.output.replace("\n", " ")
    assert run("job", rehearsed, "--plot", "job.doc").exit_code == 2


def test_other_gains_for_the_model_of_a_job(rehearsed: str, service: Service, through: Through) -> None:
    options = ("--dry-run", "--no-wait", "--json")
    begun = run("retune", TAG, "--from", rehearsed[:8], "--ms", "1.4", *options)
    assert begun.exit_code == 0, begun.output
    asked = through.posted[-1]
    assert asked["start"] == "design" and asked["Ms"] == 1.4 and asked["model"] and asked["by"] == "cli"
    service.wait(json.loads(begun.stdout)["id"])
    by_rule = run("retune", TAG, "--from", "last", "--method", "lambda", *options)
    assert by_rule.exit_code == 0 and through.posted[-1]["method"] == "lambda", by_rule.output
    other = run("retune", "FIC-2", "--from", rehearsed, "--ms", "1.4", *options)
    assert other.exit_code == 2 and f"is of loop {TAG}, not of FIC-2" in other.output
    many = run("retune", "T*", "--from", rehearsed, *options)
    assert many.exit_code == 2 and "one loop" in many.output


def test_the_report_of_a_job(rehearsed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    named = tmp_path / "filed.html"
    written = run("report", rehearsed, "--output", str(named))
    assert written.exit_code == 0, written.output
    text = named.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>") and rehearsed in text and "<script" not in text
    # without a name it has that of the loop and the job, and nothing is replaced
    by_itself = tmp_path / f"loopwright-{TAG}-{rehearsed}.html"
    assert run("report", rehearsed).exit_code == 0 and by_itself.exists()
    again = run("report", rehearsed)
    assert again.exit_code == 2 and "exists already" in again.output
    assert run("report", rehearsed, "--output", "-").stdout.startswith("<!doctype html>")
    lost = run("report", rehearsed, "--output", str(tmp_path / "none" / "file.html"))
    assert lost.exit_code == 2 and "file.html" in lost.output
    assert isinstance(run("report", "000000000000").exception, ApiError)


class TestWhichJob:
    """A job is named by its id, by as much of its beginning as no other has, or as the last one."""

    @pytest.fixture
    def ids(self, service: Service, through: Through) -> list[str]:
        found = []
        for _ in range(3):
            found.append(str(through.post(f"/loops/{TAG}/retune", {"by": "me"})["id"]))
            service.wait(found[-1])
        return found

    def test_the_last_one(self, ids: list[str]) -> None:
        assert json.loads(run("job", "last", "--json").stdout)["id"] == ids[-1]

    def test_the_last_one_is_not_decided_on(self, service: Service, ids: list[str]) -> None:
        refused = run("job", "last", "--accept")
        assert refused.exit_code == 2 and f"the last job is {ids[-1]}, of {TAG}" in refused.output
        assert service.store.get(ids[-1]).state == "proposed"
        assert run("job", ids[-1], "--rollback").exit_code == 0

    def test_the_beginning_of_an_id(self, ids: list[str]) -> None:
        for each in ids:
            begun = next(each[:n] for n in range(1, 13) if sum(other.startswith(each[:n]) for other in ids) == 1)
            assert json.loads(run("job", begun, "--json").stdout)["id"] == each

    def test_the_beginning_of_several(self, service: Service, through: Through) -> None:
        by_digit: dict[str, list[str]] = {}
        same: list[str] = []
        while len(same) < 2:
            job = service.store.create(f"L{sum(map(len, by_digit.values()))}", {}, "me", False).id
            same = by_digit.setdefault(job[0], [])
            same.append(job)
        several = run("job", same[0][0])
        assert several.exit_code == 2 and "several jobs" in several.output
        assert all(each in several.output for each in same)

    @pytest.mark.parametrize("option", ["--accept", "--rollback", "--abort", "--json"])
    def test_an_empty_id_is_that_of_no_job(
        self, proposed: str, service: Service, through: Through, option: str
    ) -> None:
        """As an unset variable of the shell gives it; there is one job, which it must not mean."""
        refused = run("job", "", option)
        assert refused.exit_code == 2 and "the id of the job is empty" in refused.output
        assert through.paths == [] and service.store.get(proposed).state == "proposed"
        assert run("report", "").exit_code == run("retune", TAG, "--from", "", "--yes").exit_code == 2

    @pytest.mark.parametrize("option", ["--accept", "--rollback"])
    def test_a_decision_takes_four_characters_of_an_id(
        self, proposed: str, service: Service, through: Through, option: str
    ) -> None:
        for short in (proposed[:1], proposed[:3]):
            refused = run("job", short, option)
            assert refused.exit_code == 2 and f"{proposed}, of {TAG}" in refused.output
            assert through.paths == [] and service.store.get(proposed).state == "proposed"
            assert run("job", short).exit_code == 0
        assert run("job", proposed[:4], option).exit_code == 0

    @pytest.mark.parametrize("given", ["nope", "%", "_", "last "])
    def test_of_none(self, ids: list[str], given: str) -> None:
        none = run("report", given)
        assert none.exit_code == 2 and f"begins with {given!r}; see: loopwright jobs" in none.output

    def test_none_at_all(self, service: Service, through: Through) -> None:
        none = run("job", "last")
        assert none.exit_code == 2 and "loopwright retune TAG" in none.output


def test_ids_and_times_are_whole_on_eighty_columns(service: Service, through: Through) -> None:
    job = through.post(f"/loops/{TAG}/retune", {"by": "me"})["id"]
    service.wait(job)
    (line,) = (line for line in run("jobs").output.splitlines() if TAG in line)
    assert job in line and " s ago" in line and len(line) <= 80
    state = service.store.get(job).state
    assert job in run("jobs", "--state", state).output and job not in run("jobs", "--state", "queued").output
    assert run("jobs", "--state", "nonsense").exit_code == 2


def test_what_users_write_is_shown_as_they_wrote_it(service: Service, through: Through) -> None:
    reason = "valve [/out] of order, see [V-12] [red]:smile:"
    through.post(f"/loops/{TAG}/lock", {"reason": reason})
    shown = run("loop", TAG)
    assert shown.exit_code == 0 and all(word in shown.output for word in reason.split())
    assert run("loops").exit_code == 0


def test_what_is_told_of_a_stage_after_the_end_of_a_job_does_not_hide_the_end(
    proposed: str, through: Through, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = {"stage": "redesign", "progress": 1.0, "remaining_plant_time_s": 0.0, "plant_time_s": 8.0}
    monkeypatch.setattr(through, "events", lambda _: iter([("state", {"state": "proposed"}), ("progress", late)]))
    told = run("job", proposed, "--follow").stderr
    assert "proposed" in told and "redesign" not in told


class TestFollowing:
    """A command that ends before what it follows says how it is followed further, and ended."""

    @pytest.fixture(params=[KeyboardInterrupt(), ServiceAway("no service at http://gateway")], ids=["ctrl-c", "away"])
    def ended(self, request: pytest.FixtureRequest, through: Through, monkeypatch: pytest.MonkeyPatch) -> BaseException:
        error: BaseException = request.param

        def end(_path: str) -> Iterator[tuple[str, dict[str, Any]]]:
            raise error

        monkeypatch.setattr(through, "events", end)
        monkeypatch.setattr(through, "awaited", end)
        return error

    @staticmethod
    def said(result: Result, error: BaseException, what: str) -> str:
        by_hand = isinstance(error, KeyboardInterrupt)
        assert result.exit_code == (130 if by_hand else 1), result.output
        assert by_hand or "no service at http://gateway" in result.stderr
        assert f"{what} {'goes on' if by_hand else 'may go on'}; " in result.stderr and result.stdout == ""
        return result.stderr

    @pytest.mark.parametrize("options", [(), ("--json",)])
    def test_a_retune(self, service: Service, through: Through, ended: BaseException, options: tuple[str, ...]) -> None:
        result = run("retune", TAG, "--yes", *options)
        job = service.store.recent()[0].id
        said = self.said(result, ended, f"job {job}")
        assert said.startswith(f"job {job} of {TAG}\n")
        assert f"loopwright job {job} --follow" in said and f"loopwright job {job} --abort" in said
        service.wait(job)

    def test_a_job(self, proposed: str, ended: BaseException) -> None:
        assert f"{proposed} --follow" in self.said(run("job", proposed[:6], "--follow"), ended, f"job {proposed}")

    def test_a_retune_of_many_loops(self, through: Through, ended: BaseException) -> None:
        result = run("retune", "TIC-*", "--yes")
        (retune,) = through.get("/batches")
        said = self.said(result, ended, f"batch {retune['id']}")
        assert said.startswith(f"batch {retune['id']} of 1 loops\n")
        assert f"{through.url}{retune['url']}/abort" in said and "loopwright batches" in said


def test_how_long_ago() -> None:
    now = datetime(2026, 11, 25, 12, 0, 0, tzinfo=UTC)
    words = {
        0.4: "0 s ago", 59.7: "59 s ago", 60.0: "1 min ago", 3599.0: "59 min ago", 3600.0: "1 h ago",
        47.9 * 3600.0: "47 h ago", 48.0 * 3600.0: "2 days ago", 900 * 86400.0: "900 days ago",
        -0.5: "0 s ago", -3.0: "2026-11-25T12:00:03+00:00",
    }  # fmt: skip
    for passed, expected in words.items():
        assert terminal.ago((now - timedelta(seconds=passed)).isoformat(), now) == expected
    assert terminal.ago("2026-11-25T11:59:00.000Z", now) == "1 min ago"


def test_the_retunes_of_many_loops(service: Service, through: Through) -> None:
    retune = through.post("/batches", {"by": "me", "pattern": "*"})["id"]
    listed = run("batches")
    assert listed.exit_code == 0 and retune in listed.output and " s ago" in listed.output
    assert json.loads(run("batches", "--json").stdout)[0]["id"] == retune


def test_the_version() -> None:
    shown = run("--version")
    assert shown.exit_code == 0 and shown.output == f"loopwright {version('loopwright')}\n"


def test_a_job_without_a_record_has_no_picture(service: Service, through: Through, tmp_path: Path) -> None:
    job = through.post(f"/loops/{TAG}/retune", {"by": "me"})["id"]
    service.wait(job)
    result = run("job", job, "--plot", str(tmp_path / "job.png"))
    assert result.exit_code == 1 and "neither a relay's record nor a set-point step" in result.output


@pytest.fixture
def proposed(service: Service, through: Through) -> str:
    """The id of a job whose proposal waits for a decision, and which has no record to be drawn."""
    job = through.post(f"/loops/{TAG}/retune", {"by": "me"})["id"]
    service.wait(job)
    assert service.store.get(job).state == "proposed"
    through.paths.clear()
    return str(job)


@pytest.mark.parametrize("decision", ["--accept", "--rollback", "--abort"])
@pytest.mark.parametrize(
    ("name", "why"),
    [("job.gif", "--plot must end in .png"), ("none/job.png", "No such file"), ("folder.png", "cannot be written")],
)
def test_a_plot_that_cannot_be_written_is_said_before_anything_is_decided(
    proposed: str, service: Service, through: Through, tmp_path: Path, decision: str, name: str, why: str
) -> None:
    (tmp_path / "folder.png").mkdir()
    refused = run("job", proposed, decision, "--plot", str(tmp_path / name))
    assert refused.exit_code == 2 and why in refused.output and name in refused.output
    assert through.paths == [] and service.store.get(proposed).state == "proposed"


def test_what_a_plot_needs_is_looked_for_before_anything_is_decided(
    proposed: str, service: Service, through: Through, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    refused = run("job", proposed, "--accept", "--plot", str(tmp_path / "job.png"))
    assert isinstance(refused.exception, ModuleNotFoundError) and refused.exception.name == "matplotlib"
    assert through.paths == [] and service.store.get(proposed).state == "proposed"


@pytest.mark.parametrize("as_json", [False, True])
def test_a_decision_is_told_although_the_plot_fails(
    proposed: str, service: Service, tmp_path: Path, as_json: bool
) -> None:
    told = run("job", proposed, "--accept", "--plot", str(tmp_path / "job.png"), *["--json"] * as_json)
    assert service.store.get(proposed).state == "accepted"
    assert told.exit_code == 1 and "neither a relay's record nor" in told.stderr and "accepted" in told.stdout
    assert not as_json or json.loads(told.stdout)["id"] == proposed


def test_a_decision_is_told_although_the_disk_is_full(
    proposed: str, service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(job_plot, "job_picture", full)
    told = run("job", proposed, "--accept", "--plot", str(tmp_path / "job.png"))
    assert told.exit_code == 1 and "job.png: No space left on device" in told.stderr and "accepted" in told.stdout
    assert service.store.get(proposed).state == "accepted"


def test_rehearse_is_fast_unless_told_otherwise(tmp_path: Path) -> None:
    file = tmp_path / "plant.json"
    file.write_text(json.dumps(PLANT))
    answer = json.loads(run("rehearse", str(file), "--ms", "1.4", "--json").stdout)
    assert (answer["method"], answer["design"]) == ("fast", {"Ms": 1.4})
    assert answer["predicted"]["Ms"] == pytest.approx(1.4, abs=0.01)
    assert answer["predicted_previous"]["Ms"] < 1.4
    assert json.loads(run("rehearse", str(file), "--method", "five-stage", "--json").stdout)["method"] == "five-stage"
    assert run("rehearse", str(file), "--method", "five-stage", "--ms", "1.4").exit_code == 2
    for name in ("--settling-s", "--mv-peak", "--noise-gain"):
        assert run("rehearse", str(file), "--method", "five-stage", name, "4").exit_code == 2
        wrong = run("rehearse", str(file), name, "nan", "--json")
        assert json.loads(wrong.stdout)["reason"] == "bad_input" and wrong.exit_code == 2
    limited = run("rehearse", str(file), "--mv-peak", "50")
    assert "MV peak" in limited.stdout and "MV peak" not in run("rehearse", str(file)).stdout


def test_rehearse_speaks_like_retune(tmp_path: Path) -> None:
    file = tmp_path / "heater.json"
    file.write_text(json.dumps({"name": "heater", "K": 0.8, "T_s": 120, "L_s": 15, "noise_std": 0.0005}))
    shown = run("rehearse", str(file))
    assert shown.exit_code == 0, shown.output
    for words in (
        "Relay test: ",
        "Model and gains: ",
        "rehearsal on heater",
        "predicted overshoot",
        "MV unit per PV unit",
    ):
        assert words in shown.output
    assert "{" not in shown.output
    echoed = json.loads(run("rehearse", str(file), "--json").stdout)["input"]
    assert echoed["num"] == [0.8] and echoed["den"] == [120.0, 1.0] and echoed["dead_time_s"] == 15.0


@pytest.mark.parametrize(
    ("plant", "words"),
    [
        ({"K": 0.8, "tau": 120, "L_s": 15}, "tau: not a quantity of the form {K, T_s, L_s}"),
        ({"num": [1.0]}, "den: it is missing"),
        ({"K": 0.8, "T_s": 120, "L_s": 15, "seed": -1}, "seed: a number of at least 0 is expected, not -1"),
    ],
)
def test_a_plant_file_that_cannot_be_used_is_refused_in_words(
    tmp_path: Path, plant: dict[str, Any], words: str
) -> None:
    file = tmp_path / "plant.json"
    file.write_text(json.dumps(plant))
    refused = run("rehearse", str(file))
    assert refused.exit_code == 2 and words in refused.output.replace("\n", " ")
    assert run("rehearse", str(file), "--json").exit_code == 2
