"""What docker-compose.yml and docker-compose.can0.yml promise, read from the files themselves."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from service.demo import loops_yaml

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


def test_one_container_alone_has_a_right_and_a_port() -> None:
    found = services("docker-compose.yml")
    assert {name for name, one in found.items() if "cap_add" in one or "user" in one or "ports" in one} == {"bus"}
    assert found["bus"]["cap_add"] == ["NET_ADMIN"]
    assert [port.split(":")[0] for port in found["bus"]["ports"]] == ["127.0.0.1"]
    assert {one["network_mode"] for name, one in found.items() if name != "bus"} == {"service:bus"}


def test_the_service_is_stopped_before_the_devices_and_they_before_the_bus() -> None:
    found = services("docker-compose.yml")
    assert {"bus", "controller", "plant"} <= set(found["service"]["depends_on"])
    assert "bus" in found["controller"]["depends_on"] and "bus" in found["plant"]["depends_on"]


def test_every_setting_is_in_the_example_with_the_default_that_holds() -> None:
    used = {}
    for name in FILES:
        for setting, default in re.findall(r"\$\{(\w+):-([^}]*)\}", (ROOT / name).read_text()):
            assert used.setdefault(setting, default) == default
    lines = (ROOT / ".env.example").read_text().splitlines()
    assert dict(line.split("=", 1) for line in lines if line and not line.startswith("#")) == used


def test_the_loops_are_those_of_the_demo_without_containers() -> None:
    assert yaml.safe_load((ROOT / "containers/loops.yaml").read_text()) == yaml.safe_load(loops_yaml("{bus}"))
