"""What each process imports: no more than it needs, and nothing in the middle of a live test."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from tests.unit.service.server.live_imports import Watch

_COMMAND = """
import sys
from loopwright.service.cli.main import main
try: main()
except SystemExit: pass
"""
_LOADED = "\nprint(*sys.modules, file=sys.stderr)"
NUMERICS = {"numpy", "scipy"}
SERVER = {"alembic", "dbos", "fastapi", "jinja2", "loopwright.service.store.tables", "sqlalchemy", "uvicorn"}
DRAWING = {"matplotlib"}
STATISTICS = {"scipy.signal", "scipy.stats"}
OPTIMISERS = {"scipy.optimize"}


def loaded_by(code: str, *arguments: str) -> set[str]:
    """The modules that a process has at its end."""
    ran = subprocess.run([sys.executable, "-c", code + _LOADED, *arguments], capture_output=True, text=True, check=True)
    return set(ran.stderr.splitlines()[-1].split())


@pytest.mark.parametrize(
    ("command", "needed", "too_much"),
    [
        (["--help"], "typer", NUMERICS | SERVER | DRAWING | {"can", "httpx", "pydantic"}),
        (["hub", "--help"], "loopwright.protocol.hub", NUMERICS | SERVER | DRAWING | {"httpx", "rich"}),
        (["controller", "--help"], "loopwright.controller.channel", SERVER | DRAWING | STATISTICS | OPTIMISERS),
        (["plant", "--help"], "loopwright.plantsim.models", SERVER | DRAWING | STATISTICS | OPTIMISERS),
        (["jobs", "--url", "http://127.0.0.1:9"], "httpx", SERVER | DRAWING | STATISTICS | OPTIMISERS | {"can"}),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_a_command_imports_no_more_than_it_needs(command: list[str], needed: str, too_much: set[str]) -> None:
    loaded = loaded_by(_COMMAND, *command)
    assert needed in loaded and loaded.isdisjoint(too_much), loaded & too_much


@pytest.mark.parametrize(
    ("module", "too_much"),
    [
        ("loopwright.service.execution.computing.preload", SERVER | DRAWING | STATISTICS | {"httpx", "rich", "can"}),
        ("loopwright.service.listening.child", {"scipy", "pydantic"} | SERVER | DRAWING),
    ],
)
def test_a_process_of_the_service_imports_no_more_than_it_needs(module: str, too_much: set[str]) -> None:
    loaded = loaded_by(f"import sys, {module}")
    assert module in loaded and loaded.isdisjoint(too_much), loaded & too_much


def test_the_service_imports_no_more_than_it_needs_and_a_live_test_nothing(tmp_path: Path) -> None:
    """An import holds the interpreter, and with it the heartbeats of all loops under test. All methods are run here,
    with what they compute in this process, as where the system gives no other: nothing is left to be imported."""
    command = [sys.executable, "-m", "tests.unit.service.server.live_imports", str(tmp_path)]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(ran.stdout)
    too_much = DRAWING | STATISTICS | {"alembic", "httpx", "jinja2", "rich"}
    assert too_much.isdisjoint(found["loaded"]), too_much & set(found["loaded"])
    assert found["seen"] == {"fast": ["proposed"], "setpoint": ["proposed"], "five-stage": ["proposed"]}


def test_what_is_not_there_is_seen() -> None:
    """The test above can fail: what watches the imports sees one."""
    with Watch() as seen, pytest.raises(ModuleNotFoundError):
        import_module("loopwright.no_such_module")
    assert seen == ["loopwright.no_such_module"]
