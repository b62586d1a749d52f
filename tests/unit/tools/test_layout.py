"""A folder of the packages can be read at one look: what is on top of it is its vocabulary and its ideas."""

from __future__ import annotations

import pytest

from tests.unit.tools.test_documents import FILES

NOT_COUNTED = {"__init__.py", "__main__.py", "py.typed"}


@pytest.mark.parametrize(("package", "most"), [("service", 20), ("tuning", 12)])
def test_entries_on_top_of_a_package(package: str, most: int) -> None:
    entries = {name.split("/")[1] for name in FILES if name.startswith(f"{package}/")} - NOT_COUNTED
    assert most - 5 <= len(entries) <= most, sorted(entries)
