"""What installs the packages of an environment: uv, with the configuration of pip, or pip."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]
TOOL: dict[str, Any] = runpy.run_path(str(ROOT / "tools" / "install_packages.py"))


def test_uv_is_told_what_pip_is_configured_with(tmp_path: Path) -> None:
    """The configuration as pip itself prints it, from a file and from the environment."""
    file = tmp_path / "pip.conf"
    file.write_text(
        "[global]\nindex-url = https://packages.invalid/simple\nextra-index-url =\n  file:///a/simple\n  file:///b\n"
        "trusted-host = packages.invalid\n[install]\nno-index = false\n[download]\nproxy = http://not.invalid\n"
    )
    told = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True,
        env={"PIP_CONFIG_FILE": str(file), "PIP_FIND_LINKS": "/wheels /more", "PIP_TIMEOUT": "7"},
    ).stdout  # fmt: skip
    given = TOOL["uv_settings"](told)  # a machine may have a configuration beside
    assert given == given | {
        "UV_DEFAULT_INDEX": "https://packages.invalid/simple",
        "UV_INDEX": "file:///a/simple file:///b",
        "UV_INSECURE_HOST": "packages.invalid",
        "UV_NO_INDEX": "false",
        "UV_FIND_LINKS": "/wheels,/more",
        "UV_HTTP_TIMEOUT": "7",
        "UV_INDEX_STRATEGY": "unsafe-best-match",
    }
    assert TOOL["uv_settings"]("") == {"UV_INDEX_STRATEGY": "unsafe-best-match"}


@pytest.mark.parametrize(("uv", "by_pip"), [("exit 0", False), ("exit 2", True), (None, True)])
def test_where_uv_fails_or_cannot_be_had_pip_installs(
    uv: str | None, by_pip: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, python = tmp_path / "log", tmp_path / "python"
    python.write_text(f'#!/bin/sh\necho "$@" >>{log}\ncase "$*" in *\\ uv) exit 1;; esac\n')
    python.chmod(0o755)
    if uv:
        (tmp_path / "uv").write_text(f"#!/bin/sh\n{uv}\n")
        (tmp_path / "uv").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    assert TOOL["main"]("service,plot") == 0
    installed = [line for line in log.read_text().splitlines() if line.endswith(f"--editable {ROOT}[service,plot]")]
    assert bool(installed) is by_pip
