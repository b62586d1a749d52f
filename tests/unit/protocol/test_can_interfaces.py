"""The CAN interfaces that a machine has, as Linux describes them in a folder."""

from __future__ import annotations

from pathlib import Path

from loopwright.protocol.bus import can_interfaces


def test_can_interfaces_are_told_from_others(tmp_path: Path) -> None:
    for name, kind in (("eth0", "1\n"), ("vcan0", "280\n"), ("can1", "280\n"), ("lo", "772\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(kind)
    (tmp_path / "bonding_masters").write_text("")
    assert can_interfaces(tmp_path) == ["can1", "vcan0"]
    assert can_interfaces(tmp_path / "not there") == []
