"""What is shipped is one top-level name that works by itself; and the checks see what is behind the links in src/."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
FOLDERS = ("containers", "controller", "plantsim", "protocol", "service", "tuning")
SHIPPED = ("pyproject.toml", "README.md", "LICENSE", "src", *FOLDERS)
PATIENCE_S = 280


def run(*command: str | Path, folder: Path) -> str:
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def copied(folder: Path) -> Path:
    """What a build needs, links as links, apart from the repository: a build leaves folders behind."""
    for name in SHIPPED:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
            )
        else:
            shutil.copy(ROOT / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source distribution, and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("built")
    run(sys.executable, "-m", "build", "--outdir", folder, copied(tmp_path_factory.mktemp("source")), folder=folder)
    return folder


@pytest.mark.timeout(2 * PATIENCE_S)
def test_the_wheel_has_one_name_on_top_and_every_file(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    in_repository = run("git", "ls-files", "--cached", "--others", "--exclude-standard", *FOLDERS, folder=ROOT).split()
    wanted = {f"loopwright/{name}" for name in in_repository if not name.endswith((".md", "/start", "/Dockerfile"))}
    assert names == wanted | {f"loopwright/{name}" for name in ("__init__.py", "py.typed", "rehearsal.py")}


@pytest.mark.timeout(2 * PATIENCE_S)
def test_the_source_distribution_holds_files_not_links(built: Path) -> None:
    (source,) = built.glob("*.tar.gz")
    with tarfile.open(source) as archive:
        assert not [member.name for member in archive if member.issym() or member.islnk()]


@pytest.mark.timeout(2 * PATIENCE_S)
def test_it_works_in_an_empty_environment(built: Path, tmp_path: Path) -> None:
    (wheel,) = built.glob("*.whl")
    run(sys.executable, "-m", "venv", tmp_path / "empty", folder=tmp_path)
    programs = tmp_path / "empty" / "bin"
    constraints = f"--constraint={ROOT / 'constraints.txt'}"
    run(programs / "python", "-m", "pip", "install", "--quiet", "--no-compile", constraints, wheel, folder=tmp_path)
    model = json.dumps({"K": 2.0, "T_s": 10.0, "L_s": 1.0})
    found = json.loads(
        run(programs / "loopwright", "tune", "--model", model, "--method", "simc", "--json", folder=tmp_path)
    )
    # SIMC (Skogestad 2003, eq. 23 and 24) with tau_c = L: Kp = T / (K 2 L), Ti = min(T, 8 L).
    gains = found["methods"][0]["gains"]
    assert gains["Kp"] == pytest.approx(2.5) and gains["Ti"] == pytest.approx(8.0)
    script = tmp_path / "mine.py"
    script.write_text(
        "from loopwright.tuning.models import FOPDT\n\nmodel: FOPDT = FOPDT(2.0, 10.0, 1.0)\nreveal_type(model.K)\n"
    )
    seen = run(
        sys.executable, "-m", "mypy", "--strict", f"--python-executable={programs / 'python'}", script, folder=tmp_path
    )
    assert re.search(r"Revealed type is .*float\"", seen)


@pytest.mark.parametrize(
    ("tool", "arguments", "wrong", "said"),
    [
        (
            "mypy",
            ("-p", "loopwright.plantsim"),
            {"plantsim/plant.py": 'WRONG: int = "no number"', "plantsim/new.py": 'WRONG: int = "no number"'},
            ("plantsim/plant.py:", "plantsim/new.py:1:"),
        ),
        (
            "lint-imports",
            ("--no-cache",),
            {
                "tuning/models.py": "import loopwright.service.states.job_state",
                "tuning/new.py": "import loopwright.protocol.bus",
            },
            (
                "loopwright.tuning.models -> loopwright.service.states.job_state",
                "loopwright.tuning.new -> loopwright.protocol.bus",
            ),
        ),
        ("ruff", ("check", "--no-cache"), {"plantsim/new.py": "import tuning.models"}, ("TID251",)),
    ],
    ids=["types", "imports", "names"],
)
def test_the_checks_see_what_is_behind_the_links(
    tool: str, arguments: tuple[str, ...], wrong: dict[str, str], said: tuple[str, ...], tmp_path: Path
) -> None:
    copied(tmp_path)
    shutil.copytree(ROOT / "validation", tmp_path / "validation")
    for file, line in wrong.items():
        with (tmp_path / file).open("a") as opened:
            opened.write(f"{line}\n")
    ended = subprocess.run(
        (Path(sys.executable).with_name(tool), *arguments),
        cwd=tmp_path,
        env=dict(os.environ, PYTHONPATH="src"),  # before the repository, which is installed as editable
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert ended.returncode != 0 and all(each in ended.stdout for each in said), ended.stdout
