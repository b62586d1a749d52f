"""The relay's record, sample by sample, where the loop does not do as loops do."""

from __future__ import annotations

import pytest

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace
from loopwright.tuning.fast.relay.relay_test import RelayTest
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, Sample
from loopwright.tuning.reasons import Reason, Refused


def test_a_PV_that_stands_still_while_MV_switches_is_refused() -> None:
    facts = Facts(0.1, 3.0, 0.0, 100.0, 2.0, Gains(1.0, 3.0), True)
    listened = Trace()
    for n in range(60):
        listened.add(Sample(0.1 * n, 50.0, 50.0 + 0.01 * (-1) ** n, 50.0, Mode.AUTOMATIC))
    point = OperatingPoint(50.0, 50.0, 50.0, 0.01, 40.0)
    relay = RelayTest(facts, point, listened, None).relay(4)
    next(relay)
    with pytest.raises(Refused) as refused:
        for n in range(60, 100):
            relay.send(Sample(0.1 * n, 50.0, 50.0, 60.0 if n // 10 % 2 else 45.0, Mode.EXPERIMENT))
    assert refused.value.reason is Reason.NO_RESPONSE
