"""Which tests start processes is found out; what the tests counted is told at the end of the run."""

from __future__ import annotations

import gc
import os
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from types import ModuleType
from typing import Any

import pytest
from hypothesis import settings

from loopwright.service.cli.demo import vcan_usable
from tests.browser import CHROMIUM
from tests.migrated_once import migrated_once

settings.register_profile("untimed", settings.default, deadline=None)  # a busy machine makes any test slow
settings.load_profile("untimed")
gc.disable()  # until all tests are collected: next to nothing becomes garbage, and each collection goes through all
_STARTERS = {
    "subprocess",
    "multiprocessing",
    "loopwright.service.cli.child_process",
    "loopwright.service.server.serving",
    "loopwright.service.execution.computing.pool",
}
_ONLY_COMPUTING = ("tests/rehearsal/", "tests/unit/tuning/", "tests/unit/validation/")

_COUNTS = pytest.StashKey[dict[str, Counter[str]]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_COUNTS] = {}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all-on-vcan", action="store_true", help="over vcan0 too whatever goes over the hub")
    parser.addoption("--each-once", action="store_true", help="not over the hub what the mark on_vcan names for vcan0")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks what may fail where processes start slowly: `python -m tests.repeat` repeats it beside a load.

    What only computes comes last: at the end, when other work of this machine is through, tests that wait would leave
    the processors idle.
    """
    by_default, each_once = not config.getoption("--all-on-vcan"), config.getoption("--each-once")
    left_out = [
        item
        for item in items
        if isinstance(item, pytest.Function)
        and (chosen := item.get_closest_marker("on_vcan")) is not None
        and _is_left_out(item, chosen, by_default, each_once)
    ]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]
    for item in items:
        if isinstance(item, pytest.Function) and starts_processes(item.module):
            item.add_marker(pytest.mark.starts_processes)
    items.sort(key=lambda item: item.nodeid.startswith(_ONLY_COMPUTING))


def pytest_collection_finish() -> None:
    """The garbage collector goes through all tests and modules again and again: an eighth of the processor's time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 50)
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """A test that wants vcan0 or a browser is skipped where there is none, and fails where all must run."""
    if item.get_closest_marker("vcan") and not vcan_usable():
        if os.environ.get("LOOPWRIGHT_REQUIRE_VCAN"):
            pytest.fail("no vcan0")
        pytest.skip("no vcan0: run under tools/with-vcan")
    if item.get_closest_marker("browser") and not shutil.which(CHROMIUM):
        if os.environ.get("LOOPWRIGHT_REQUIRE_BROWSER"):
            pytest.fail(f"no {CHROMIUM}")
        pytest.skip(f"no {CHROMIUM}: the Debian package of that name has it")


def _is_left_out(item: pytest.Function, chosen: pytest.Mark, by_default: bool, each_once: bool) -> bool:
    """Whether a test with the mark on_vcan is left out over its bus: over vcan0 one whose parameters the mark does not
    name (user-mode Linux takes several times as long for each system call as the hub does); over the hub, where each
    runs once, one that it names."""
    named = bool(set(item.callspec.params.values()) & set(chosen.args))
    over_vcan = item.get_closest_marker("vcan") is not None
    return (by_default and not named) if over_vcan else (each_once and named)


@cache
def starts_processes(module: ModuleType) -> bool:
    """True where the module, or a module of the tests that it uses, has something of those that start processes."""
    used = {value if isinstance(value, ModuleType) else _home(value) for value in vars(module).values()} - {module}
    names = {each.__name__ for each in used if each is not None}
    if names & _STARTERS:
        return True
    return any(starts_processes(each) for each in used if each is not None and each.__name__.startswith("tests."))


def _home(value: object) -> ModuleType | None:
    name = getattr(value, "__module__", None)
    return sys.modules.get(name) if isinstance(name, str) else None


@pytest.fixture(scope="session")
def fuzz_count(pytestconfig: pytest.Config) -> Counter[str]:
    """What the fuzzing of the OpenAPI document tried, by kind."""
    return pytestconfig.stash[_COUNTS].setdefault("OpenAPI fuzzing", Counter())


@pytest.fixture(scope="session")
def machine_count(pytestconfig: pytest.Config) -> Counter[str]:
    """What the state machine over jobs did, by rule and outcome."""
    return pytestconfig.stash[_COUNTS].setdefault("State machine over jobs", Counter())


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Where several processes share the tests (pytest-xdist), each hands over what its own have counted."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["counts"] = {
            title: dict(each) for title, each in session.config.stash[_COUNTS].items()
        }


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    counts = node.config.stash[_COUNTS]
    for title, found in getattr(node, "workeroutput", {}).get("counts", {}).items():
        counts.setdefault(title, Counter()).update(found)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for title, counts in config.stash[_COUNTS].items():
        told = ", ".join(f"{count} {kind}" for kind, count in counts.items())
        terminalreporter.write_line(f"{title}: {told}")


@pytest.fixture(autouse=True, scope="session")
def tables_made_once() -> Iterator[None]:
    with migrated_once():
        yield
