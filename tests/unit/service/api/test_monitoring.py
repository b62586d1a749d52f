"""Prometheus as Debian has it scrapes the service; the alert rules and the queries of the dashboard work in it."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from fastapi.testclient import TestClient
from grafana_foundation_sdk.models.dashboard import Dashboard

from tests.ports import free_port
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import Service
from tests.unit.service.processes import until
from tests.unit.service.served import served

FOLDER = Path(__file__).parents[4] / "tools" / "monitoring"
RULES = yaml.safe_load((FOLDER / "alerts.yml").read_text(encoding="utf-8"))["groups"][0]["rules"]
DASHBOARD = json.loads((FOLDER / "dashboard.json").read_text(encoding="utf-8"))
QUERIES = [target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", ())]
needs_prometheus = pytest.mark.skipif(shutil.which("promtool") is None, reason="needs Debian's package prometheus")


def test_the_dashboard_is_what_its_script_makes_and_grafana_knows_all_of_it() -> None:
    spec = importlib.util.spec_from_file_location("dashboard", FOLDER / "dashboard.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert script.text() == (FOLDER / "dashboard.json").read_text(encoding="utf-8")
    assert Dashboard.from_json(DASHBOARD).title == "Loopwright" and len(QUERIES) == 18


def test_what_alerts_and_dashboard_ask_for_is_there(client: TestClient) -> None:
    shown = client.get("/metrics").text
    there = set(re.findall(r"^# TYPE (\w+)", shown, re.MULTILINE))
    for query in [*QUERIES, *(rule["expr"] for rule in RULES)]:
        for name in re.findall(r"loopwright_\w+", query):
            assert {name, name.removesuffix("_bucket"), name.removesuffix("_total")} & there, name
    assert re.search(r'^loopwright_build_info\{python="[\d.]+",version="[\d.]+"\} 1\.0$', shown, re.MULTILINE)


@needs_prometheus
@pytest.mark.parametrize("command", [("check", "rules", "alerts.yml"), ("test", "rules", "alerts_test.yml")])
def test_promtool_accepts_the_alert_rules(command: tuple[str, ...]) -> None:
    ended = subprocess.run(["promtool", *command], cwd=FOLDER, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_every_alert_says_what_to_do() -> None:
    for rule in RULES:
        assert rule["annotations"]["summary"] and rule["annotations"]["action"] and rule["labels"]["severity"]


@pytest.fixture
def prometheus(service: Service, tmp_path: Path) -> Iterator[httpx.Client]:
    """Prometheus that scrapes the service each second, with the alert rules."""
    with ExitStack() as stack, served(app_of(service.jobs)) as server:
        shutil.copy(FOLDER / "alerts.yml", tmp_path)
        config = {
            "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
            "rule_files": ["alerts.yml"],
            "scrape_configs": [
                {"job_name": "loopwright", "static_configs": [{"targets": [f"127.0.0.1:{server.port}"]}]}
            ],
        }
        (tmp_path / "prometheus.yml").write_text(yaml.safe_dump(config))
        port = free_port()
        command = (
            "prometheus", "--config.file=prometheus.yml", "--storage.tsdb.path=data", "--log.level=warn",
            f"--web.listen-address=127.0.0.1:{port}",
        )  # fmt: skip
        log = stack.enter_context((tmp_path / "log").open("w"))
        with subprocess.Popen(command, cwd=tmp_path, stdout=log, stderr=log) as run:
            try:
                with httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False) as client:
                    yield client
            finally:
                run.terminate()


def asked(client: httpx.Client, query: str) -> list[dict[str, Any]]:
    """The result of a query; nothing while Prometheus is not ready."""
    try:
        answer = client.get("/api/v1/query", params={"query": query})
    except httpx.TransportError:
        return []
    if answer.status_code == 503:
        return []
    body = answer.json()
    assert body["status"] == "success", (query, body)
    found: list[dict[str, Any]] = body["data"]["result"]
    return found


@needs_prometheus
def test_prometheus_scrapes_the_service(prometheus: httpx.Client) -> None:
    until(lambda: [each["value"][1] for each in asked(prometheus, "up")] == ["1"], "a first scrape")
    # a rate needs two scrapes
    until(lambda: asked(prometheus, "rate(loopwright_http_requests_total[5m])"), "a second scrape")
    for query in QUERIES:
        found = asked(prometheus, query)
        if "stage" not in query and "bus" not in query and "listening_up" not in query:
            assert found, query  # there are no tests and no bus here
    assert asked(prometheus, "sum(loopwright_loops)")[0]["value"][1] == "2"
    rules = prometheus.get("/api/v1/rules").json()["data"]["groups"][0]["rules"]
    assert {rule["name"] for rule in rules} == {rule["alert"] for rule in RULES}
    until(lambda: not [rule for rule in prometheus.get("/api/v1/rules").json()["data"]["groups"][0]["rules"]
                       if rule["health"] != "ok"], "every rule evaluated")  # fmt: skip
