"""What the tests counted is told at the end of the run."""

from __future__ import annotations

from collections import Counter

import pytest

_COUNTS = pytest.StashKey[dict[str, Counter[str]]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_COUNTS] = {}


@pytest.fixture(scope="session")
def fuzz_count(pytestconfig: pytest.Config) -> Counter[str]:
    """What the fuzzing of the OpenAPI document tried, by kind."""
    return pytestconfig.stash[_COUNTS].setdefault("OpenAPI fuzzing", Counter())


@pytest.fixture(scope="session")
def machine_count(pytestconfig: pytest.Config) -> Counter[str]:
    """What the state machine over jobs did, by rule and outcome."""
    return pytestconfig.stash[_COUNTS].setdefault("State machine over jobs", Counter())


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for title, counts in config.stash[_COUNTS].items():
        told = ", ".join(f"{count} {kind}" for kind, count in counts.items())
        terminalreporter.write_line(f"{title}: {told}")
