from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.api.app import create_app
from tests.unit.service.fakes import Service

with warnings.catch_warnings():
    # starlette warns that its test client will want another HTTP package one day.
    warnings.simplefilter("ignore")
    from fastapi.testclient import TestClient


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    yield service
    service.close()


@pytest.fixture
def client(service: Service) -> Iterator[TestClient]:
    with TestClient(create_app(service.jobs), raise_server_exceptions=False) as client:
        yield client
