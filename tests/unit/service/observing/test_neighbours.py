from __future__ import annotations

from typing import Any

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.observing.neighbours import disturbers
from tests.unit.service.fakes import loop_entry


def loop(tag: str, **changes: Any) -> LoopConfig:
    return LoopConfig.model_validate(loop_entry(tag=tag, **changes))


def test_loops_of_an_area_and_an_inner_loop_disturb() -> None:
    outer, beside = loop("TIC-1", area="top"), loop("TIC-2", area="top")
    inner, apart = loop("FIC-1", setpoint_from="remote", outer_loop="TIC-1"), loop("LIC-1", area="sump")
    site = [outer, beside, inner, apart, loop("PIC-1")]
    assert disturbers(outer, site) == ["FIC-1", "TIC-2"]
    assert disturbers(beside, site) == ["TIC-1"]
    assert disturbers(inner, site) == disturbers(apart, site) == disturbers(loop("PIC-1"), site) == []
