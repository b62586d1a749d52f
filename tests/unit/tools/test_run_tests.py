"""The lanes of `make test`: what has failed is run once more, alone; only what passes then does not fail the whole."""

from __future__ import annotations

import subprocess
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[3]
PASSES = "def test_passes(): pass\n"
FAILS = "def test_fails(): assert False\n"
PASSES_ALONE = """
from pathlib import Path
def test_passes_alone():
    ran = Path(__file__).with_name("ran")
    first, _ = not ran.exists(), ran.touch()
    assert not first
"""


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    loader = SourceFileLoader("run_tests", str(ROOT / "tools/run-tests"))
    spec = spec_from_loader("run_tests", loader)
    assert spec is not None
    module = module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "run_tests", module)
    loader.exec_module(module)
    for name in ("LOOPWRIGHT_REQUIRE_VCAN", "LOOPWRIGHT_REQUIRE_BROWSER", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "1")  # so that it is as before when this test is over
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    return module


@pytest.mark.parametrize(
    ("tests", "check", "status"),
    [
        ((PASSES_ALONE, PASSES_ALONE, PASSES_ALONE), "true", 0),
        ((PASSES, PASSES, PASSES_ALONE + FAILS), "true", 1),
        ((PASSES, "import nothing_of_that_name\n", PASSES), "true", 2),
        ((PASSES, PASSES, PASSES), "false", 1),
    ],
    ids=["each passes alone", "one of two fails", "no test", "the check fails"],
)
def test_the_status_is_that_of_what_fails_alone_too(
    tool: ModuleType,
    tests: tuple[str, str, str],
    check: str,
    status: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # they take longer than these tests
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    lanes = []
    for name, source in zip(("vcan", "hub", "computing"), tests, strict=True):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"test_{name}.py").write_text(source)
        lanes.append(tool.Lane(name, (name,), beside=("-q",)))
    assert tool.main(sys.executable, (), tuple(lanes), (check,)) == status
    told = capfd.readouterr().out
    for name, source in zip(("vcan", "hub", "computing"), tests, strict=True):
        named = f"   {name}/test_{name}.py::test_passes_alone" in told
        assert named == ("test_passes_alone" in source)
        assert (f"{name}/test_{name}.py" in told) or "fails" not in source
    assert "== lane vcan" in told and "== lane hub" in told


@pytest.mark.parametrize(
    ("command", "status", "again"),
    [
        ("echo began; test -e vcan-ran -a -e hub-ran", 0, False),
        ("test -e second || { touch second; exit 2; }", 0, True),
        ("exit 3", 3, True),
    ],
    ids=["it passes behind the two lanes", "it passes alone", "it fails"],
)
def test_a_command_runs_when_the_lanes_on_a_bus_are_through(
    tool: ModuleType,
    command: str,
    status: int,
    again: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    for name in ("vcan", "hub", "computing"):
        (tmp_path / f"test_{name}.py").write_text(f"def test(): open('{name}-ran', 'w').close()\n")
    lanes = tuple(tool.Lane(name, (f"test_{name}.py",), beside=("-q",)) for name in ("vcan", "hub", "computing"))
    assert tool.main(sys.executable, ("sh", "-c", command), lanes, ("true",)) == status
    told = capfd.readouterr().out
    assert f"== sh -c {command}: " in told and ("began" in told) == ("began" in command)
    assert ("once more, alone" in told) == again


def test_a_command_that_is_not_there_is_said_before_anything_runs(tool: ModuleType) -> None:
    with pytest.raises(SystemExit, match="there is no command compose-tset"):
        tool.main(sys.executable, ("compose-tset",))


def test_no_folder_of_tests_is_left_out(tool: ModuleType) -> None:
    vcan, hub, computing = tool.LANES
    of_hub = {each for each in hub.tests if each.startswith("tests/")}
    assert {f"--ignore={folder}" for folder in of_hub} == {each for each in computing.tests if "--ignore" in each}
    marked = [each for each in (ROOT / "tests").glob("*/*.py") if "mark.vcan" in each.read_text()]
    of_vcan = {each for each in vcan.tests if each.startswith("tests/")}
    assert {f"tests/{each.parent.name}" for each in marked} == of_vcan


@pytest.mark.parametrize("name", ["vcan", "hub", "computing"])
def test_pytest_takes_the_options_of_each_lane(tool: ModuleType, name: str) -> None:
    (lane,) = (lane for lane in tool.LANES if lane.name == name)
    options = [each for each in (*lane.tests, *lane.beside) if each.startswith("-") and "--ignore" not in each]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "-qq", "--collect-only", "tests/unit/tools/test_run_tests.py"],
        capture_output=True, text=True, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == (5 if name == "vcan" else 0), done.stdout + done.stderr  # 5: nothing is selected
