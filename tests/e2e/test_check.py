"""A plant of one's own on a bus, found by `loopwright probe` and read by `loopwright check`, as processes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.forked import ForkedProcess

HEATER = {"K": 0.8, "T_s": 120, "L_s": 15, "mv": 40, "pv": 65}
LOOP = {
    "tag": "HEATER", "controller_node": 0x20, "plant_node": 0x10, "pv_unit": "degC",
    "pv_limits": {"low": 40.0, "high": 90.0}, "t95_s": 400.0, "sp_deviation": 1.0,
}  # fmt: skip


@pytest.fixture
def heater(bus: str, tmp_path: Path) -> Iterator[str]:
    """The bus with a controller and the heater on it."""
    with ExitStack() as stack:
        for name, *options in (
            ("controller", "--kp", "1", "--ti", "120", "--sp", "65"),
            ("plant", "--model", json.dumps(HEATER), "--speed", "10"),
        ):
            command = ("loopwright.service", name, "--bus", bus, "--ts", "1", *options)
            process = ForkedProcess(name, command, tmp_path / f"{name}.log")
            stack.callback(process.stop)
            process.wait_ready()
        yield bus


def command(*arguments: str) -> tuple[int, Any]:
    """The exit status of a command, and the JSON that it prints; it says nothing by standard error."""
    run = subprocess.run(
        [sys.executable, "-m", "loopwright.service", *arguments, "--json"], capture_output=True, text=True
    )
    assert run.stderr == ""
    return run.returncode, json.loads(run.stdout)


def test_a_plant_of_ones_own_is_found_and_its_loop_read(heater: str, tmp_path: Path) -> None:
    status, nodes = command("probe", "--bus", heater)
    assert status == 0
    assert [(each["node"], each["device"], each["channels"], each["sample_time_s"]) for each in nodes] == [
        (0x10, "plant", 1, 1.0), (0x20, "controller", 1, 1.0),
    ]  # fmt: skip
    loops = tmp_path / "loops.yaml"
    swapped = {"tag": "SWAPPED", "controller_node": 0x10, "plant_node": 0x20}
    loops.write_text(yaml.safe_dump({"loops": [LOOP | {"bus": heater}, LOOP | {"bus": heater} | swapped]}))
    status, (well, wrong) = command("check", str(loops))
    assert status == 3
    assert (well["answers"], well["problem"], well["mode"], well["sp"]) == (True, None, "automatic", 65.0)
    assert 55.0 < well["pv"] < 75.0
    assert not wrong["answers"] and "swapped in loops.yaml" in wrong["problem"]
