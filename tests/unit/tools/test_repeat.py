"""`python -m tests.repeat`, and which tests it repeats."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import pytest

from tests import repeat
from tests.conftest import starts_processes
from tests.repeat import Round, once
from tests.unit.containers import test_bus, test_data_volume
from tests.unit.protocol import test_hub
from tests.unit.service.execution import test_computing
from tests.unit.service.server import test_serving, test_start, test_stop, test_survival
from tests.unit.tuning.analysis import test_margins

TESTS = """
import subprocess

def test_is_good():
    pass

def test_starts_a_service():
    subprocess.run(["true", "serve"])

def test_is_not():
    subprocess.run(["true"])
    print("what it said")
    assert not "this time"
"""


def test_what_failed_is_known_by_name_with_its_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # loading them takes longer than all else here
    file = tmp_path / "test_of_the_test.py"
    file.write_text(TESTS)
    found = once(["-c", "/dev/null", str(file)], tmp_path)
    assert "1 failed, 2 passed" in found.last
    assert list(found.failed) == ["test_of_the_test::test_is_not"]
    assert all(words in found.failed["test_of_the_test::test_is_not"] for words in ("this time", "what it said"))
    assert found.services == ["test_of_the_test.py::test_starts_a_service"]
    found = once(["-c", "/dev/null", str(tmp_path / "nowhere.py")], tmp_path)
    assert "it ended with status 4" in found.failed["pytest itself"]


def test_every_failure_is_told_and_counted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    good = Round("2 passed", {}, ["c::starts"])
    ends = iter([good, Round("1 failed", {"a::b": "its words"}, []), good, Round("1 failed", {"a::b": "more"}, [])])
    asked: list[Sequence[str]] = []

    def once(arguments: Sequence[str], folder: Path) -> Round:
        asked.append(arguments)
        return next(ends)

    monkeypatch.setattr(repeat, "once", once)
    assert repeat.main(["--times", "4", "--busy", "1", "--", "-k", "this"]) == 1
    told = capsys.readouterr().out
    assert "1 of 4, 0 s: 2 passed\n2 of 4, 0 s: 1 failed\nFAILED a::b\nits words\n" in told
    assert told.endswith("a::b failed 2 of 4 times\n")
    assert asked == [("-k", "this")] * 4
    ends = iter([good, good])
    assert repeat.main(["--times", "2", "--busy", "0", "--at-once", "3"]) == 0
    beside = ("--numprocesses=3", "--dist=loadfile")
    assert asked[-2:] == [(*beside, *repeat.ALL), (*beside, "c::starts")]


def test_the_load_is_there_meanwhile_and_no_longer() -> None:
    with repeat.busy(2) as processes:
        assert [process.poll() for process in processes] == [None, None]
    assert [process.poll() for process in processes] == [-signal.SIGKILL] * 2


STARTING = (
    test_bus, test_computing, test_data_volume, test_hub, test_serving, test_start, test_stop, test_survival,
)  # fmt: skip


@pytest.mark.parametrize("module", STARTING, ids=lambda module: str(module.__name__).rpartition(".")[2])
def test_those_that_start_processes_are_found(module: ModuleType) -> None:
    assert starts_processes(module)


def test_others_are_not() -> None:
    assert not starts_processes(test_margins)


def test_the_marker_is_put_on_by_itself(request: pytest.FixtureRequest) -> None:
    assert request.node.get_closest_marker("starts_processes") is not None  # tests.repeat starts some
