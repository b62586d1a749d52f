"""What works without the extras: tuning, identification and rehearsal; and what is said where an extra is missing."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.unit.service.offline.exported_files import FILES

ROOT = Path(__file__).parents[4]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = {
    "service": (
        "alembic", "dbos", "fastapi", "httpx", "jinja2", "prometheus_client", "psycopg", "can", "yaml",
        "sqlalchemy", "standardwebhooks", "uvicorn", "starlette",
    ),
    "plot": ("matplotlib",),
}  # fmt: skip
"""What each extra brings, by the names that are imported."""
RUN = (
    "import sys\n"
    f"for name in {sorted(EXTRAS['service'] + EXTRAS['plot'])}: sys.modules[name] = None\n"
    "from loopwright.service.cli.main import main\n"
    "sys.argv[0] = 'loopwright'\n"
    "main()\n"
)
TANK = """
from loopwright import rehearsal, tuning

class Tank:
    sample_time_s, t95_s, level = 1.0, 130.0, 1.0

    def step(self, mv):
        self.level += 0.05 * (mv / 50.0 - self.level**0.5)
        return self.level
"""
MODEL = '{"K": 0.8, "T_s": 120, "L_s": 15}'


def loopwright(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs a command where only what the base installation brings can be imported."""
    return subprocess.run([sys.executable, "-c", RUN, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "arguments",
    [
        ("tune", "--model", MODEL),
        ("tune", "--model", MODEL, "--json"),
        ("methods",),
        ("methods", "--json"),
        ("identify", "plain.csv"),
        ("identify", "plain.csv", "--tune", "--json"),
        ("rehearse", "plant.json"),
        ("rehearse", "plant.json", "--json"),
        ("rehearse", "tank.py:Tank", "--json"),
        ("--version",),
        ("--help",),
    ],
    ids=" ".join,
)
def test_it_works_without_the_extras(arguments: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "plain.csv").write_bytes(FILES["plain"].content)
    (tmp_path / "plant.json").write_text(json.dumps({"K": 2.0, "T_s": 5.0, "L_s": 1.0}))
    (tmp_path / "tank.py").write_text(TANK)
    files = (".csv", "plant.json", ".py:Tank")
    paths = [str(tmp_path / each) if each.endswith(files) else each for each in arguments]
    ended = loopwright(*paths)
    assert ended.returncode == 0, ended.stderr
    if "--json" in arguments:
        json.loads(ended.stdout)


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (("loops",), "service"),
        (("jobs",), "service"),
        (("check", "loops.yaml"), "service"),
        (("serve",), "service"),
        (("demo",), "service"),
        (("plant", "--model", MODEL), "service"),
        (("tune", "--model", MODEL, "--plot", "tune.png"), "plot"),
    ],
    ids=str,
)
def test_the_extra_that_is_missing_is_named(arguments: tuple[str, ...], extra: str, tmp_path: Path) -> None:
    ended = loopwright(*arguments)
    assert ended.returncode == 2 and f"pip install 'loopwright[{extra}]'" in ended.stderr, ended.stderr
    assert "Traceback" not in ended.stderr


def test_tuning_needs_numpy_and_scipy_alone() -> None:
    code = (
        "import sys; import loopwright.tuning\n"
        "print(*{name.partition('.')[0] for name in sys.modules} & {'typer', 'rich', 'pydantic', 'fastapi', 'can'})"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


def test_the_extras_are_those_of_the_project() -> None:
    for extra, names in EXTRAS.items():
        named = {re.split(r"[\[<>=]", each)[0] for each in PROJECT["optional-dependencies"][extra]}
        imported = {"python-can": "can", "pyyaml": "yaml", "prometheus-client": "prometheus_client"}
        assert {imported.get(name, name) for name in named} == set(names) - {"starlette"}
