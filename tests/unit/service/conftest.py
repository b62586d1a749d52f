from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from loopwright.service.security.principal import SERVICE, current
from loopwright.service.store.store import Store
from loopwright.service.telemetry import logs
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import Service
from tests.unit.service.postgres import Server, binaries

with warnings.catch_warnings():
    # starlette warns that its test client will want another HTTP package one day.
    warnings.simplefilter("ignore")
    from fastapi.testclient import TestClient


@pytest.fixture(autouse=True)
def as_the_service() -> Iterator[None]:
    """A command that ran in this process leaves word of who gave it."""
    token = current.set(SERVICE)
    yield
    current.reset(token)


@pytest.fixture(autouse=True)
def own_log() -> Iterator[None]:
    """A service that ran in this process leaves its log behind, on a stream that is closed with the test."""
    yield
    root = logging.getLogger()
    for handler in root.handlers.copy():
        if isinstance(handler.formatter, (logs.Lines, logs.JsonLines)):
            root.removeHandler(handler)
            logging.captureWarnings(False)


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    yield service
    service.close()


@pytest.fixture
def client(service: Service) -> Iterator[TestClient]:
    with TestClient(app_of(service.jobs), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def shared_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service for the tests of a module that change nothing of it."""
    service = Service(tmp_path_factory.mktemp("shared"))
    yield service
    service.close()


@pytest.fixture(scope="module")
def shared_client(shared_service: Service) -> Iterator[TestClient]:
    """Its client, for requests that are refused or read only: to make an application takes 0.1 s of processor time."""
    with TestClient(app_of(shared_service.jobs), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    """A private server. Skipped where there is none to start, but not where the tests must be complete."""
    found = binaries()
    if found is None:
        assert not os.environ.get("CI"), "the tests need the package postgresql"
        pytest.skip("no PostgreSQL server is installed")
    server = Server(found)
    yield server
    server.close()


@pytest.fixture(params=["sqlite", "postgresql"])
def store(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Store]:
    database = None if request.param == "sqlite" else request.getfixturevalue("postgres").database()
    store = Store(tmp_path, database)
    yield store
    store.close()
