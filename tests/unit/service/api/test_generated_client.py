"""A client generated from the OpenAPI document is typed to the gains, and does what the document says."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from loopwright.service.api.gate.gate import Policy
from loopwright.service.execution.procedures import rehearse
from loopwright.service.security.keys import Scope
from loopwright.service.store.keyring import Keyring
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import FakeLoop, Service
from tests.unit.service.served import served

PACKAGE = "loopwright_client"
SCRIPT = f'''"""What a user writes."""

import sys
import time

from {PACKAGE} import AuthenticatedClient
from {PACKAGE}.api.jobs import get_job, list_job_events
from {PACKAGE}.api.loops import list_loops, retune_loop
from {PACKAGE}.api.tunings import tune_model
from {PACKAGE}.models import (
    FastRetune,
    FirstOrderModel,
    FiveStageRetune,
    GainsView,
    JobState,
    JobView,
    LoopView,
    Problem,
    RuleRetune,
    RuleRetuneMethod,
    StageStartedEvent,
    StateEvent,
    TuningRequest,
)

PLANT = FirstOrderModel(k=0.2, t_s=2.4, l_s=1.8)


def first_loop(client: AuthenticatedClient) -> LoopView:
    found = list_loops.sync(client=client)
    assert isinstance(found, list)
    return found[0]


def rehearsed(client: AuthenticatedClient, tag: str, wanted: FastRetune | FiveStageRetune | RuleRetune) -> GainsView:
    started = retune_loop.sync(tag, client=client, body=wanted)
    assert isinstance(started, JobView), started
    while started.state in (JobState.QUEUED, JobState.RUNNING):
        time.sleep(0.05)
        now = get_job.sync(started.id, client=client)
        assert isinstance(now, JobView), now
        started = now
    assert started.state is JobState.REHEARSED and started.new_gains is not None, started
    events = list_job_events.sync(started.id, client=client)
    assert isinstance(events, list)
    stages = {{event.stage: event.remaining_plant_time_s for event in events if isinstance(event, StageStartedEvent)}}
    assert [event.state for event in events if isinstance(event, StateEvent)][-1] == started.state
    assert [event.id for event in events] == list(range(1, len(events) + 1)) and stages, events
    return started.new_gains


def main(url: str, key: str) -> None:
    with AuthenticatedClient(base_url=url, token=key) as client:
        loop = first_loop(client)
        gains = rehearsed(client, loop.tag, FastRetune(dry_run=True, ms=1.4, model=PLANT))
        print(loop.tag, gains.kp, gains.ti)
        gains = rehearsed(client, loop.tag, RuleRetune(method=RuleRetuneMethod.SIMC, dry_run=True, model=PLANT))
        print(loop.tag, gains.kp, gains.ti)
        refused = retune_loop.sync(loop.tag, client=client, body=FastRetune(start="start", ms=1.4))  # WRONG
        assert isinstance(refused, Problem), refused
        tuned = tune_model.sync(client=client, body=TuningRequest(model=PLANT, method="simc"))
        assert not isinstance(tuned, Problem) and tuned is not None
        (simc,) = tuned.methods
        assert simc.gains is not None and tuned.model == PLANT
        print(simc.method, simc.gains.kp, simc.gains.ti)


if __name__ == "__main__":
    main(*sys.argv[1:])
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("client")


def run(*command: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    apart = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "MYPY"))}
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=200, check=False, env=apart)


def checked(script: str, folder: Path) -> str:
    """What mypy says of a script that uses the client."""
    (folder / "script.py").write_text(script)
    return run(sys.executable, "-m", "mypy", "--strict", "--config-file=", "script.py", folder=folder).stdout


@pytest.mark.timeout(600)
def test_a_script_on_the_generated_client(service: Service, folder: Path) -> None:
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearse)
    keyring = Keyring(service.store.engine)
    _, key = keyring.create("script", Scope.OPERATE)
    app = app_of(jobs, Policy(keyring))

    (folder / "openapi.json").write_text(json.dumps(app.openapi()))
    (folder / "generator.yaml").write_text("post_hooks: []\n")
    generated = run(
        sys.executable, "-m", "openapi_python_client", "generate", "--path", "openapi.json", "--config",
        "generator.yaml", "--meta", "none", "--output-path", PACKAGE, "--fail-on-warning", folder=folder,
    )  # fmt: skip
    assert generated.returncode == 0 and "arning" not in generated.stdout + generated.stderr, generated

    wrong = checked(SCRIPT, folder)
    assert wrong.count("error:") == 1 and 'Argument "start"' in wrong, "mypy sees into the types of the client"
    right = SCRIPT.replace('body=FastRetune(start="start", ms=1.4))  # WRONG', "body=FastRetune(model=PLANT))")
    assert checked(right, folder).startswith("Success"), "and finds nothing else"

    with served(app) as server:
        ended = run(sys.executable, "script.py", f"http://127.0.0.1:{server.port}", key, folder=folder)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    fast, rule, simc = (line.split() for line in ended.stdout.splitlines())
    assert fast[0] == rule[0] == "FIC-2" and simc[0] == "simc"
    assert fast[1:] != rule[1:]
    # SIMC on K 0.2, T 2.4 s, L 1.8 s: Kp = T/(2 K L), Ti = min(T, 8 L)
    assert [float(text) for text in simc[1:]] == pytest.approx([2.4 / (2 * 0.2 * 1.8), 2.4])
