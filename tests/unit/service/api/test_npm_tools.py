"""The OpenAPI document under Spectral's rules, and a TypeScript client of it that compiles and retunes a loop."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from loopwright.service.api.gate.gate import Policy
from loopwright.service.execution.procedures import rehearse
from loopwright.service.security.keys import Scope
from loopwright.service.store.keyring import Keyring
from tests.unit.service.api.test_api import GOLDEN
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import FakeLoop, Service
from tests.unit.service.served import served

SOURCES = Path(__file__).parents[3] / "npm"
PATIENCE_S = 280


def run(*command: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the tools that tests/npm names, at the versions that its lock file has."""
    if shutil.which("npm") is None:
        pytest.skip("needs npm")
    made = tmp_path_factory.mktemp("npm") / "npm"
    shutil.copytree(SOURCES, made, ignore=shutil.ignore_patterns("node_modules"))
    installed = run("npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", folder=made)
    assert installed.returncode == 0, installed.stdout + installed.stderr
    shutil.copy(GOLDEN, made / "openapi.json")
    return made


@pytest.mark.timeout(600)
def test_spectral_finds_nothing_in_the_document(folder: Path) -> None:
    spectral = folder / "node_modules/.bin/spectral"
    found = run(spectral, "lint", "openapi.json", "--fail-severity=hint", folder=folder)
    assert found.returncode == 0, found.stdout + found.stderr
    document = json.loads((folder / "openapi.json").read_text())
    document["paths"]["/loops"]["get"]["tags"] = ["nowhere"]
    (folder / "wrong.json").write_text(json.dumps(document))
    found = run(spectral, "lint", "wrong.json", "--fail-severity=hint", folder=folder)
    assert found.returncode != 0 and "operation-tag-defined" in found.stdout


@pytest.mark.timeout(600)
def test_a_typescript_client_compiles_and_retunes_a_loop(service: Service, folder: Path) -> None:
    made = run(
        folder / "node_modules/.bin/openapi-typescript", "openapi.json", "--default-non-nullable", "false",
        "--output", "loopwright.d.ts", folder=folder,
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    compiler = (
        folder / "node_modules/.bin/tsc", "--strict", "--noUncheckedIndexedAccess", "--module", "nodenext",
        "--moduleResolution", "nodenext", "--target", "es2022", "--outDir", "out",
    )  # fmt: skip
    wrong = folder / "wrong.ts"
    wrong.write_text((folder / "retune.ts").read_text().replace("Ms: 1.4", 'Ms: "robust"'))
    seen = run(*compiler, "wrong.ts", folder=folder)
    assert seen.returncode != 0 and "Type 'string' is not assignable to type 'number'" in seen.stdout, "types are seen"
    compiled = run(*compiler, "retune.ts", folder=folder)
    assert compiled.returncode == 0, compiled.stdout

    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearse)
    keyring = Keyring(service.store.engine)
    _, key = keyring.create("script", Scope.OPERATE)
    with served(app_of(jobs, Policy(keyring))) as server:
        ended = run("node", "out/retune.js", f"http://127.0.0.1:{server.port}", key, folder=folder)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    fast, simc = (line.split() for line in ended.stdout.splitlines())
    assert fast[0] == "FIC-2" and float(fast[1]) > 0.0
    # SIMC on K 0.2, T 2.4 s, L 1.8 s: Kp = T/(2 K L), Ti = min(T, 8 L)
    assert [float(text) for text in simc[1:]] == pytest.approx([2.4 / (2 * 0.2 * 1.8), 2.4])
