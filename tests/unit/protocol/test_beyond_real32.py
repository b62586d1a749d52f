"""Values beyond the range of a REAL32: no device ends because of one, and none begins with one."""

from __future__ import annotations

import math

import pytest

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.protocol.profile import PV_FRAME, Mode
from tests.unit.protocol.rig import IDS, Rig


def test_a_plant_whose_pv_is_too_large_sends_an_infinite_pv_and_goes_on() -> None:
    rig = Rig()
    assert rig.write("plant_noise", 3e38) is None
    rig.run(50)
    sent = [PV_FRAME.unpack(data) for data in rig.wire.sent(IDS.pv)]
    assert [number for _, number in sent] == list(range(1, 51))
    assert any(math.isinf(pv) for pv, _ in sent)
    assert rig.controller.channels[0].mv == 50.0


@pytest.mark.parametrize("value", [1e39, -1e39, math.inf, math.nan])
class TestNoBeginning:
    def test_of_a_set_point_or_an_output(self, value: float) -> None:
        for setpoint, output in ((value, 0.0), (0.0, value)):
            with pytest.raises(ValueError, match="range of a REAL32"):
                Channel(0.1, Settings(), Parameters(1.0), setpoint, Mode.AUTOMATIC, output)

    def test_of_limits(self, value: float) -> None:
        with pytest.raises(ValueError, match="range of a REAL32"):
            Settings(mv_high=value)

    def test_of_gains(self, value: float) -> None:
        with pytest.raises(ValueError, match="range of a REAL32"):
            Parameters(value)


def test_the_largest_real32_is_a_value_as_others() -> None:
    assert Settings(pv_high=3.4028234663852886e38).measured(50.0)
