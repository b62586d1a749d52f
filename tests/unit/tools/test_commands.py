"""Every command that a stranger would try in a clone works, or says in a sentence what it wants."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks.__main__ import BENCHMARKS

ROOT = Path(__file__).parents[3]
MODULES = sorted(
    ".".join(file.relative_to(ROOT).with_suffix("").parts)
    for folder in ("benchmarks", "validation", "tests/faults", "tests/simulation")
    for file in (ROOT / folder).glob("*.py")
    if 'if __name__ == "__main__":' in file.read_text()
)
WITHOUT_A_COMMAND_LINE = {"tests.faults.own_clock"}  # runs another module, with the arguments of that one
TARGETS = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[0].split()


def run(command: Sequence[str], folder: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=folder,
        env=dict(os.environ, **environment),
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


class Ended:
    """What python -m MODULE ARGUMENTS says, here in this process: imports are what takes time."""

    def __init__(self, patch: pytest.MonkeyPatch, capture: pytest.CaptureFixture[str], *command: str) -> None:
        patch.setattr(sys, "argv", list(command))
        patch.delitem(sys.modules, command[0], raising=False)
        with pytest.raises(SystemExit) as ended:
            runpy.run_module(command[0], run_name="__main__", alter_sys=True)
        self.status = ended.value.code
        self.out, self.err = capture.readouterr()


@pytest.mark.parametrize("module", sorted(set(MODULES) - WITHOUT_A_COMMAND_LINE))
def test_every_module_that_is_a_command_has_help(
    module: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = Ended(monkeypatch, capsys, module, "--help")
    assert ended.status == 0 and ended.out.startswith("usage: ") and not ended.err


@pytest.mark.parametrize(
    ("arguments", "known"),
    [
        (["benchmarks.__main__", "criterion", "nonsense"], list(BENCHMARKS)),
        (["benchmarks.tuning", "--cases", "nonsense"], ["PI 1 %"]),
        (["benchmarks.peers", "--case", "nonsense"], ["PI 1 %"]),
        (["benchmarks.refusals", "nowhere", "nonsense"], ["no_response", "diverges"]),
    ],
)
def test_a_name_that_nothing_has_is_one_line_with_those_that_are(
    arguments: list[str], known: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = Ended(monkeypatch, capsys, *arguments)
    assert ended.status == 2 and not ended.out
    assert len(ended.err.splitlines()) == 1 and "'nonsense'" in ended.err
    assert all(name in ended.err for name in known)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["benchmarks.tuning", "--part", "3/2"], "--part"),
        (["benchmarks.tuning", "--seeds", "x"], "--seeds"),
        (["benchmarks.tuning", "--of", "nowhere"], "no run: nowhere"),
        (["benchmarks.fast", "x"], "records"),
        (["benchmarks.rehearsed_gateway"], "folder"),
        (["validation.__main__", "nonsense"], "nonsense"),
        (["tests.faults.__main__", "--faults", "nonsense"], "nonsense"),
        (["tests.simulation.__main__", "--kinds", "nonsense"], "nonsense"),
    ],
)
def test_arguments_that_are_none_are_refused_in_words(
    arguments: list[str], words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = Ended(monkeypatch, capsys, *arguments)
    assert ended.status == 2 and words in ended.err


def test_as_a_process() -> None:
    found = run([sys.executable, "-m", "benchmarks", "nonsense"])
    assert found.returncode == 2 and not found.stdout
    assert found.stderr == f"python -m benchmarks: no benchmark is called 'nonsense'; known: {', '.join(BENCHMARKS)}\n"


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """What make needs of a clone."""
    folder = tmp_path / "clone"
    folder.mkdir()
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "tools", folder / "tools")
    return folder


needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="there is no make here")


@needs_make
@pytest.mark.parametrize("target", TARGETS)
def test_every_target_can_be_made_in_an_empty_clone(clone: Path, target: str) -> None:
    found = run(["make", "--dry-run", target], clone)
    assert found.returncode == 0 and not found.stderr


@needs_make
def test_each_target_is_told_at_the_head_of_the_makefile() -> None:
    head = (ROOT / "Makefile").read_text().partition("\n\n")[0]
    told = set(re.findall(r"make ([a-z-]+)", head))
    assert set(TARGETS) - told == {"system", "clean"}  # a part of others; what everybody knows


@needs_make
def test_clean_takes_away_what_setup_made_and_nothing_else(clone: Path) -> None:
    (clone / ".venv/bin").mkdir(parents=True)
    (clone / "loopwright.egg-info").mkdir()
    for _ in range(2):
        assert run(["make", "clean"], clone).returncode == 0
    assert sorted(each.name for each in clone.iterdir()) == ["Makefile", "constraints.txt", "pyproject.toml", "tools"]


class StandIns:
    """A PATH with the tools of any system and the stand-ins given, and nothing else."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        for name in ("sh", "grep", "cat", "rm", "mkdir", "echo"):
            found = shutil.which(name)
            assert found
            (folder / name).symlink_to(found)

    def add(self, name: str, script: str) -> None:
        file = self.folder / name
        file.write_text(f"#!/bin/sh\n{script}\n")
        file.chmod(0o755)

    def run(self, *command: str) -> subprocess.CompletedProcess[str]:
        return run(["sh", *command], PATH=str(self.folder))


@pytest.fixture
def system(tmp_path: Path) -> StandIns:
    return StandIns(tmp_path / "bin")


TOOL = str(ROOT / "tools/system-packages")


@pytest.mark.parametrize("user", ["0", "1000"])
def test_nothing_is_said_where_every_package_is_there(system: StandIns, user: str) -> None:
    system.add("dpkg-query", "echo install ok installed")
    system.add("id", f"echo {user}")
    found = system.run(TOOL, "one", "two")
    assert (found.returncode, found.stdout, found.stderr) == (0, "", "")


@pytest.mark.parametrize("user", ["0", "1000"])
@pytest.mark.parametrize("apt", ["missing", "without a network", "there"])
def test_what_cannot_be_installed_is_said_with_the_line_to_type(system: StandIns, apt: str, user: str) -> None:
    """Also where there is no dpkg: another kind of Linux."""
    system.add("id", f"echo {user}")
    called = system.folder.parent / "called"
    if apt != "missing":
        system.add("apt-get", f"echo $* >>{called}; exit {int(apt != 'there')}")
    found = system.run(TOOL, "user-mode-linux", "iproute2")
    assert found.returncode == 0
    if apt == "there" and user == "0":
        assert "install -y -qq --no-install-recommends user-mode-linux iproute2" in called.read_text()
        assert found.stdout == "Installing: user-mode-linux iproute2\n"
        return
    assert "apt-get install --no-install-recommends user-mode-linux iproute2" in found.stdout
    assert "modprobe vcan" in found.stdout
    assert called.exists() == (apt != "missing" and user == "0")


VENV = str(ROOT / "tools/make-venv")


def test_without_python_it_is_said_what_to_install(system: StandIns, tmp_path: Path) -> None:
    found = system.run(VENV, "python3", str(tmp_path / "venv"), "dev")
    assert found.returncode == 1 and "there is no python3 here" in found.stderr
    assert "apt-get install python3 python3-venv" in found.stderr


def test_of_an_old_python_too(system: StandIns, tmp_path: Path) -> None:
    system.add("python3", 'case "$1" in --version) echo Python 3.9.2;; *) exit 1;; esac')
    found = system.run(VENV, "python3", str(tmp_path / "venv"), "dev")
    assert found.returncode == 1 and "Python 3.11 or newer, with venv: python3 is Python 3.9.2" in found.stderr


def test_of_a_python_without_venv(system: StandIns, tmp_path: Path) -> None:
    system.add("python3", 'case "$2" in *ensurepip*) exit 1;; esac')
    found = system.run(VENV, "python3", str(tmp_path / "venv"), "dev")
    assert found.returncode == 1 and "python3 has no venv or no ensurepip" in found.stderr
    assert "python3-venv" in found.stderr


@pytest.mark.parametrize("there", [True, False])
def test_an_environment_whose_python_works_is_kept(system: StandIns, tmp_path: Path, there: bool) -> None:
    program, log = tmp_path / "venv/bin/python", tmp_path / "log"
    python = f'#!/bin/sh\necho "$0 $@" >>{log}'
    make = f"mkdir -p {program.parent}; echo '{python}' >{program}; chmod +x {program}"
    system.add("python3", f'case "$1" in -m) {make};; esac')
    (system.folder / "chmod").symlink_to(shutil.which("chmod") or "")
    if there:
        program.parent.mkdir(parents=True)
        program.write_text(f"{python}\n# mine\n")
        program.chmod(0o755)
    assert system.run(VENV, "python3", str(tmp_path / "venv"), "dev").returncode == 0
    assert ("# mine" in program.read_text()) is there
    assert log.read_text().splitlines()[-1] == f"{program} {ROOT}/tools/install_packages.py dev"
