"""The documents as a site: every link leads somewhere, every page is in the table of contents."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
BUILD = (sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "--keep-going", "-n")


def built(source: Path, site: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*BUILD, str(source), str(site)], capture_output=True, text=True, check=False)


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    ended = built(ROOT / "docs", tmp_path / "site")
    assert ended.returncode == 0, ended.stderr
    first = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    for wanted in ("My heater swings", "My CSV is from a historian", "I have a hundred loops", "I teach"):
        assert wanted in first
    for notebook in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        assert (tmp_path / "site" / notebook.name).exists() and f'href="{notebook.name}"' in first


def test_a_broken_link_is_seen(tmp_path: Path) -> None:
    source = tmp_path / "docs"
    shutil.copytree(ROOT / "docs", source)
    (source / "methods.md").write_text("# Methods\n\n[nowhere](nothing.md) [no heading](safety.md#nothing)\n")
    ended = built(source, tmp_path / "site")
    assert ended.returncode != 0 and "'nothing.md'" in ended.stderr and "not found in doc 'safety'" in ended.stderr
