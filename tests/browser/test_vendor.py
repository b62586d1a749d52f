"""What the tests put into the page from elsewhere is what VERSIONS says, under its licence."""

from __future__ import annotations

import hashlib
from pathlib import Path

VENDOR = Path(__file__).parent / "vendor"


def test_the_files_are_those_of_the_list() -> None:
    lines = (VENDOR / "VERSIONS").read_text().splitlines()
    listed = {line.split()[0]: line.split()[-1] for line in lines}
    names = {path.name for path in VENDOR.iterdir()} - {"VERSIONS", "LICENSES"}
    assert {name: hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() for name in names} == listed


def test_each_has_its_licence() -> None:
    licences = (VENDOR / "LICENSES").read_text()
    for line in (VENDOR / "VERSIONS").read_text().splitlines():
        _, name, version, licence, _ = line.split()
        assert f"{name} {version}\n" in licences and licence == "MPL-2.0"
    assert "Mozilla Public License, version 2.0" in licences
    assert f"v{version}" in (VENDOR / "axe.min.js").read_text()[:200]
