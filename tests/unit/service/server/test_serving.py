from __future__ import annotations

import gc
import sys
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from loopwright.protocol.profile import TUNER_NODE
from loopwright.service.cli.main import app
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.jobs.manager import Jobs
from loopwright.service.server import serving
from loopwright.service.store.lock import FolderInUse
from tests.unit.service.fakes import FakeTune, loop_entry


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--database", "postgresql://me:secret@127.0.0.1:1/none"], "needs --gateway"),
        (["--database", "postgresql://me:secret@127.0.0.1:1/none", "--gateway", "a"], "the database cannot be used"),
        (["--database", "mysql://me:secret@127.0.0.1:1/none", "--gateway", "a"], "not mysql://"),
    ],
)
def test_a_database_that_cannot_be_used_is_said_in_words(tmp_path: Path, options: list[str], words: str) -> None:
    loops = tmp_path / "loops.yaml"
    loops.write_text(yaml.safe_dump({"loops": [loop_entry()]}))
    place = ["--loops", str(loops), "--data", str(tmp_path / "data"), "--port", "0"]
    ended = CliRunner().invoke(app, ["serve", *place, *options])
    assert ended.exit_code == 2 and words in ended.output
    assert "secret" not in ended.output and "Traceback" not in ended.output


def test_a_start_that_is_refused_begins_no_computation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its end would wait for the fork server, on a busy machine for longer than the pool waits."""
    begun: list[object] = []
    monkeypatch.setattr(Pool, "submit", lambda pool, *work: begun.append(work))
    loops = tmp_path / "loops.yaml"
    loops.write_text(yaml.safe_dump({"loops": [loop_entry()]}))
    (tmp_path / "data").write_text("a file where the folder should be")
    place = ["--loops", str(loops), "--data", str(tmp_path / "data"), "--port", "0"]
    ended = CliRunner().invoke(app, ["serve", *place])
    assert ended.exit_code == 2 and "it is a file" in ended.output
    assert begun == []


@pytest.mark.parametrize("node", ["0", "128", "x", "-3"])
def test_a_node_id_that_is_none_is_refused(tmp_path: Path, node: str) -> None:
    ended = CliRunner().invoke(app, ["serve", "--data", str(tmp_path / "data")], env={"LOOPWRIGHT_NODE": node})
    assert ended.exit_code == 2 and "--node must be a CANopen node id, 1 to 127" in ended.output


@pytest.mark.parametrize(("node", "name"), [("0x20", "controller_node"), ("16", "plant_node")])
def test_a_node_id_that_a_device_has_is_refused(tmp_path: Path, node: str, name: str) -> None:
    loops = tmp_path / "loops.yaml"
    loops.write_text(yaml.safe_dump({"loops": [loop_entry()]}))
    place = ["--loops", str(loops), "--data", str(tmp_path / "data"), "--port", "0"]
    ended = CliRunner().invoke(app, ["serve", *place, "--node", node])
    assert ended.exit_code == 2 and f"TIC-101: {name} is {int(node, 0):#04x}" in ended.output
    assert "start it with another --node" in ended.output and not (tmp_path / "data").exists()


def test_the_node_id_is_that_of_every_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[serving.Setup] = []
    monkeypatch.setattr(serving, "serve", asked.append)
    for options in ([], ["--node", "0x7C"]):
        assert CliRunner().invoke(app, ["serve", *options]).exit_code == 0
    assert [setup.node for setup in asked] == [TUNER_NODE, 0x7C]


def test_when_the_jobs_begin_all_is_loaded_and_no_collection_looks_through_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full collection lets no thread run: of what is loaded it takes a tenth of a second or more."""
    kept = []

    def boot(_jobs: Jobs) -> None:
        kept.append(gc.get_freeze_count())
        raise FolderInUse("that is enough")

    monkeypatch.setattr(Jobs, "boot", boot)
    loops = tmp_path / "loops.yaml"
    loops.write_text(yaml.safe_dump({"loops": [loop_entry()]}))
    gc.unfreeze()  # what other tests have kept
    try:
        with pytest.raises(FolderInUse, match="enough"):
            serving.serve(serving.Setup(loops, tmp_path / "data", "127.0.0.1", 0), tune=FakeTune())
        assert kept[0] > 10_000 and "loopwright.tuning.five_stage.procedure" in sys.modules
    finally:
        gc.unfreeze()


@pytest.mark.parametrize("value", ["proxy.example", "10.0.0.7/8", ""])
def test_a_trusted_proxy_that_is_no_address_is_refused(tmp_path: Path, value: str) -> None:
    ended = CliRunner().invoke(app, ["serve", "--data", str(tmp_path / "data"), "--trusted-proxy", value])
    assert ended.exit_code == 2 and "--trusted-proxy takes an address or a network" in ended.output


def test_trusted_proxies_and_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[serving.Setup] = []
    monkeypatch.setattr(serving, "serve", asked.append)
    given = ["--trusted-proxy", "10.0.0.7", "--trusted-proxy", "10.1.0.0/16", "--connections", "100"]
    from_environment = {"LOOPWRIGHT_TRUSTED_PROXIES": "10.0.0.7 10.1.0.0/16", "LOOPWRIGHT_CONNECTIONS": "100"}
    assert CliRunner().invoke(app, ["serve", *given]).exit_code == 0
    assert CliRunner().invoke(app, ["serve"], env=from_environment).exit_code == 0
    assert CliRunner().invoke(app, ["serve"]).exit_code == 0
    trusted = [[str(each) for each in setup.trusted_proxies] for setup in asked]
    assert trusted == [["10.0.0.7/32", "10.1.0.0/16"], ["10.0.0.7/32", "10.1.0.0/16"], []]
    limits = [(setup.limits.connections, setup.limits.connections_of_address) for setup in asked]
    assert limits == [(100, 50), (100, 50), (512, 256)]
