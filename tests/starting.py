"""A plugin of pytest (`-p tests.starting`) that notes in the JUnit report which tests start a service as a process."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest

STARTS_A_SERVICE = "starts_a_service"
"""The property of a test in the report; its value is pytest's name of the test."""
_SERVING = frozenset({"serve", "demo", "tests.unit.service.gateway"})
"""Commands of `loopwright` that run a service, and a module that is one."""
FORKED = "tests.forked"
"""The audit event of a process that is forked from one which has everything loaded."""

_started: list[Sequence[object]] = []


def _hear(event: str, arguments: tuple[object, ...]) -> None:
    if event == "subprocess.Popen" and isinstance(arguments[1], list | tuple):
        _started.append(arguments[1])
    elif event == FORKED:
        _started.append(arguments)


sys.addaudithook(_hear)


@contextmanager
def _noted(item: pytest.Item) -> Iterator[None]:
    before = len(_started)
    yield
    if any(_SERVING.intersection(map(str, command)) for command in _started[before:]):
        found = (STARTS_A_SERVICE, item.nodeid)
        if found not in item.user_properties:
            item.user_properties.append(found)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    with _noted(item):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    with _noted(item):
        return (yield)
