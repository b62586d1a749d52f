"""docs/operations.md: every command on it is run, in its order, against real services and a real PostgreSQL.

Paths are moved below a temporary folder. The stand-ins (tests/unit/service/stand-ins) are for what a test must not do
to the machine: become another user, install packages, talk to systemd. Their systemctl starts what the unit file says.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.ports import free_port
from tests.unit.service.postgres import Server, binaries

ROOT = Path(__file__).parents[4]
PAGE = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
UNIT = ROOT / "tools" / "loopwright.service"
STAND_INS = Path(__file__).parents[1] / "stand-ins"
LOOPS = """
loops:
- {tag: TIC-101, bus: 'virtual:page', controller_node: 32, pv_unit: degC, pv_limits: {low: 0, high: 100}, t95_s: 9,
   sp_deviation: 2}
"""
pytestmark = pytest.mark.timeout(600)


def blocks(section: str) -> list[str]:
    """The commands of a section of the page."""
    text = re.split(r"^## ", PAGE, flags=re.MULTILINE)
    (found,) = [part for part in text if part.startswith(f"{section}\n")]
    return re.findall(r"^```sh\n(.*?)^```$", found, flags=re.MULTILINE | re.DOTALL)


SECTIONS = re.findall(r"^## (.+)$", PAGE, flags=re.MULTILINE)


class Machine:
    """A folder that stands for a machine, and a shell that takes it for one."""

    def __init__(self, folder: Path, database: str = "") -> None:
        self.folder = folder
        for name in ("etc/systemd/system", "etc/sysctl.d", "opt", "usr/local/bin", "var/lib", "var/backups", "run"):
            (folder / name).mkdir(parents=True)
        self.port = free_port()
        work = folder / "clone"
        (work / "tools").mkdir(parents=True)
        shutil.copy(UNIT, work / "tools")
        (work / "loops.yaml").write_text(LOOPS)
        (work / "constraints.txt").touch()
        postgres = binaries()
        path = [str(STAND_INS), str(folder / "usr/local/bin"), *([str(postgres)] if postgres else [])]
        self._environment = {
            "PATH": ":".join([*path, os.environ["PATH"]]),
            "HOME": str(folder),
            "MACHINE": str(folder),
            "PYTHON": sys.executable,
            "PYTHONPATH": str(ROOT),
            "LOOPWRIGHT_URL": f"http://127.0.0.1:{self.port}",
            **({"PGHOST": database, "PGUSER": "loopwright", "PGDATABASE": "postgres"} if database else {}),
        }

    def run(self, commands: str, *, key: str = "", database: str = "") -> str:
        """Runs commands of the page to the end; the first that fails ends the test."""
        text = re.sub(r"(?<![\w.])/(etc|opt|var|usr/local)/", rf"{self.folder}/\1/", commands)
        text = text.replace(":8080", f":{self.port}").replace("--bind 0.0.0.0", f"--bind 0.0.0.0 --port {self.port}")
        text = text.replace("loopwright@db.example:5432/loopwright", database)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", text],
            cwd=self.folder / "clone",
            env=self._environment | ({"LOOPWRIGHT_KEY": key} if key and "read -r" not in commands else {}),
            input=f"{key}\n",
            capture_output=True,
            text=True,
            timeout=240,
        )
        logs = "".join(path.read_text() for path in (self.folder / "run").glob("*.log"))
        assert done.returncode == 0, f"{text}\n{done.stdout}{done.stderr}\n{logs}"
        return done.stdout

    def stop(self) -> None:
        subprocess.run([STAND_INS / "systemctl", "stop", "loopwright"], env=self._environment, check=False)


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    machine = Machine(tmp_path)
    yield machine
    machine.stop()


def test_no_section_with_commands_is_left_out() -> None:
    tried = {"Install", "Keys", "Rotate a key", "Back up", "Restore", "Damaged data", "Upgrade"}
    tried |= {"Add a gateway", "Watch", "Many loops"}
    assert {section for section in SECTIONS if blocks(section)} == tried
    # Nor is anything fenced or indented that is no block of commands: each of these is taken up by name below.
    fences = re.findall(r"^ *(```.*)$", PAGE, flags=re.MULTILINE)
    assert fences == ["```sh", "```"] * sum(len(blocks(section)) for section in tried)
    assert not re.search(
        r"^(    |\t)\S", re.sub(r"^```sh\n.*?^```$", "", PAGE, flags=re.MULTILINE | re.DOTALL), re.MULTILINE
    )


def test_one_machine(machine: Machine) -> None:
    (install,) = blocks("Install")
    first = install.replace("enable --now", f"set-options --port={machine.port} && systemctl enable --now")
    assert '"ready":true' in machine.run(first)
    create, use = blocks("Keys")
    key, other = machine.run(create).split("\n")[:2]
    assert key.startswith("lw_") and other.startswith("lw_")
    assert "TIC-101" in machine.run(use, key=key)
    refused = machine.run("curl --silent http://127.0.0.1:8080/loops")
    assert '"status":401' in refused
    (rotate,) = blocks("Rotate a key")
    told = machine.run(rotate)
    new = told.split("\n")[0]
    assert "revoked" in told
    (back_up,), (restore,), (upgrade,) = (blocks(name) for name in ("Back up", "Restore", "Upgrade"))
    assert "checked" in machine.run(back_up)
    later = machine.run(create.split("\n")[1].replace("monitoring", "later"))
    assert "restored" in machine.run(restore)
    use_it = 'curl --silent -w "%{http_code}" -H "Authorization: Bearer $LOOPWRIGHT_KEY" http://127.0.0.1:8080/loops'
    assert [machine.run(use_it, key=k.strip())[-3:] for k in (new, key, later)] == ["200", "401", "401"]
    (damaged,) = blocks("Damaged data")
    assert "whole; readable rows" in machine.run(damaged)
    assert '"ready":true' in machine.run(upgrade, key=new)
    (many,) = blocks("Many loops")
    assert '"url":"/batches/' in machine.run(many, key=new)
    (look,) = blocks("Watch")
    assert '"level"' in machine.run(look)


def test_a_gateway_more(tmp_path: Path, postgres: Server) -> None:
    host = quote(str(postgres.folder), safe="")
    machine = Machine(tmp_path, str(postgres.folder))
    try:
        once, gateway, restore = blocks("Add a gateway")
        install = blocks("Install")[0].split("sudo systemctl enable")[0]
        # The server's own superuser has the name already.
        machine.run(re.sub(r"(ROLE|--owner) loopwright", r"\1 gateways", once))
        machine.run(install)
        url = f"gateways@/loopwright?host={host}"
        key = machine.run(gateway, database=url).split("\n")
        secret = next(line for line in key if line.startswith("lw_"))
        ready = 'curl --fail --silent -H "Authorization: Bearer $LOOPWRIGHT_KEY" http://127.0.0.1:8080/readyz'
        assert '"ready":true' in machine.run(ready, key=secret)
        machine.run(restore, database=url)
        assert '"ready":true' in machine.run(ready, key=secret)
        log = (tmp_path / "run" / "command").read_text().split("\n")
        assert ["--no-resume" in line for line in log if line][-2:] == [True, False]
    finally:
        machine.stop()


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit with a program that is there."""
    if shutil.which("systemd-analyze") is None:
        assert not os.environ.get("CI"), "the tests need the package systemd"
        pytest.skip("systemd is not installed")
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace("/opt/loopwright/bin/loopwright", "/bin/true"))
    return unit


def test_the_unit_file_is_one(unit: Path) -> None:
    done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    about_it = [line for line in done.stderr.splitlines() if "loopwright" in line]
    assert about_it == []


def test_the_unit_gives_no_more_than_the_service_needs(unit: Path) -> None:
    """2.5 of 10 as systemd counts; what is left is the network, the buses among it."""
    security = ["systemd-analyze", "security", "--offline=true", "--no-pager"]
    done = subprocess.run([*security, "--threshold=25", unit], capture_output=True, text=True)
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd can only look at units that are installed")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Service may allocate packet sockets" not in done.stdout


def test_the_unit_lets_the_service_reach_its_buses_and_bounds_it() -> None:
    lines = UNIT.read_text().splitlines()
    (families,) = [line for line in lines if line.startswith("RestrictAddressFamilies=")]
    assert "AF_CAN" in families.split() and "CapabilityBoundingSet=" in lines
    assert not any(line.startswith(("AmbientCapabilities=", "PrivateNetwork=")) for line in lines)
    assert {"MemoryMax=2G", "WatchdogSec=90", "Type=notify", "Restart=on-failure"} <= set(lines)
