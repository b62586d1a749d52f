"""What docker-compose.yml and docker-compose.can0.yml promise, read from the files themselves."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml

from loopwright.service.cli.demo import TAG, loops_yaml

ROOT = Path(__file__).parents[3]
FILES = ("docker-compose.yml", "docker-compose.can0.yml")


def services(name: str) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = yaml.safe_load((ROOT / name).read_text())["services"]
    return found


@pytest.mark.parametrize("name", FILES)
def test_every_container_is_confined(name: str) -> None:
    for one in services(name).values():
        assert one["read_only"] is True
        assert one["cap_drop"] == ["ALL"]
        assert one["security_opt"] == ["no-new-privileges:true"]
        assert one["stop_grace_period"] == "10s"


@pytest.mark.parametrize("name", FILES)
def test_every_module_that_a_container_runs_is_there(name: str) -> None:
    lines = [one[key] for one in services(name).values() for key in ("command", "entrypoint") if key in one]
    lines += [one["healthcheck"].get("test", []) for one in services(name).values() if "healthcheck" in one]
    modules = {line[at + 1] for line in lines for at, word in enumerate(line) if word == "-m"}
    assert modules and all(module.startswith("loopwright.") for module in modules), modules
    assert all(find_spec(module) is not None for module in modules), modules


def test_the_buses_alone_have_a_right_and_a_port() -> None:
    found = services("docker-compose.yml")
    buses = {name: one for name, one in found.items() if "cap_add" in one or "user" in one or "ports" in one}
    assert set(buses) == {"bus", "bus-b"}
    for one in buses.values():
        assert one["cap_add"] == ["NET_ADMIN"]
        assert [port.split(":")[0] for port in one["ports"]] == ["127.0.0.1"]
    assert found["database"]["network_mode"] == "none"
    for name in set(found) - set(buses) - {"database"}:
        assert found[name]["network_mode"] == ("service:bus-b" if name.endswith("-b") else "service:bus")


@pytest.mark.parametrize("end", ["", "-b"])
def test_the_service_is_stopped_before_the_devices_and_they_before_the_bus(end: str) -> None:
    found = services("docker-compose.yml")
    assert {f"bus{end}", f"controller{end}", f"plant{end}"} <= set(found[f"service{end}"]["depends_on"])
    assert found[f"controller{end}"]["depends_on"] == found[f"plant{end}"]["depends_on"] == [f"bus{end}"]


def test_the_second_gateway_is_the_first_but_for_its_names() -> None:
    found = services("docker-compose.yml")
    second = {name for name, one in found.items() if one.get("profiles") == ["postgres"]}
    assert second == {"bus-b", "plant-b", "controller-b", "service-b", "database"}
    assert not any("profiles" in found[name] for name in set(found) - second)
    assert "database" in found["service-b"]["depends_on"]
    a, b = found["service"], found["service-b"]
    assert b["command"] == [
        *a["command"][:3], "--need=LOOPWRIGHT_DATABASE", "--set=tag=TIC-201", *a["command"][4:]
    ]  # fmt: skip
    assert a["environment"]["LOOPWRIGHT_DATABASE"] == b["environment"]["LOOPWRIGHT_DATABASE"]
    for own in ("LOOPWRIGHT_GATEWAY", "LOOPWRIGHT_NODE"):
        assert a["environment"][own] != b["environment"][own]
    for one in (a, b, found["database"]):
        assert "database-socket:/run/postgresql" in one["volumes"]


def test_every_setting_is_in_the_example_with_the_default_that_holds() -> None:
    used = {}
    for name in FILES:
        for setting, default in re.findall(r"\$\{(\w+):-([^}]*)\}", (ROOT / name).read_text()):
            assert used.setdefault(setting, default) == default
    lines = (ROOT / ".env.example").read_text().splitlines()
    assert dict(line.split("=", 1) for line in lines if line and not line.startswith("#")) == used


def test_the_loops_are_those_of_the_demo_without_containers() -> None:
    ours = (ROOT / "containers/loops.yaml").read_text().replace("{tag}", TAG)
    assert yaml.safe_load(ours) == yaml.safe_load(loops_yaml("{bus}"))
    assert f"--set=tag={TAG}" in services("docker-compose.yml")["service"]["command"]
