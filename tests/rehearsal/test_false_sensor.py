"""A sensor that lies within PV's limits ends each procedure at once; a true one never does. `benchmarks.false_sensor`
has other plants, moments and phases."""

from __future__ import annotations

import pytest

from benchmarks.false_sensor import METHODS, RULE_PLANTS, Case, measured, true_sensor
from loopwright.plantsim.sensors import SensorFault
from loopwright.tuning.fast.manual.procedure import MANUAL
from loopwright.tuning.fast.pulses.procedure import SETPOINT
from loopwright.tuning.fast.relay.procedure import FAST
from loopwright.tuning.five_stage.procedure import PROCEDURE
from loopwright.tuning.reasons import FalsePv

ONE_LAG = RULE_PLANTS[0]
REST = {PROCEDURE: 104, FAST: 124, SETPOINT: 124, MANUAL: 124}
"""The number of samples before the first command, or one or two more."""
IN_NOISE = (SensorFault.QUIET, SensorFault.LOUD)


@pytest.mark.parametrize("after", [8, 36])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("fault", [fault for fault in SensorFault if fault is not SensorFault.HALVED])
def test_a_false_sensor_ends_the_test_at_once(fault: SensorFault, method: str, after: int) -> None:
    found = measured(Case(ONE_LAG, method, "", fault, 1, REST[method] + after))
    assert found.told, found.reason
    # noise is told from noise by chance only: half of these in the time allowed, the others soon after
    assert found.samples <= (2.0 if fault in IN_NOISE else 1.0) * found.allowed
    if fault not in IN_NOISE:
        assert found.beyond == 0.0


@pytest.mark.parametrize("seed", range(20_001, 20_011))
def test_a_true_sensor_is_not_taken_for_false(seed: int) -> None:
    words, ended = true_sensor(seed)
    assert not isinstance(ended, FalsePv), (words, ended)
