"""A loop that is not at rest is looked at again, and is judged by the last look alone."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from loopwright.tuning.experiments.preflight import MAX_ATTEMPTS, at_rest
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, Sample, StageStarted, Work
from loopwright.tuning.reasons import Reason, Refused

TS, T95, SP = 0.1, 20.0, 50.0
FACTS = Facts(TS, T95, 0.0, 100.0, 1.0, Gains(1.0, 10.0))
LOOK_S = T95 / 2


def listen(
    pv: Callable[[float], float], sp: Callable[[float], float] = lambda t: SP
) -> tuple[OperatingPoint, Trace, list[str], float]:
    """With the stages and notes on the way, and the plant time at the end, s."""
    plan, told, n = at_rest(FACTS, 1.0), list[str](), 0
    answer = next(plan)
    while True:
        told += [item.stage if isinstance(item, StageStarted) else type(item).__name__ for item in answer]
        for item in answer:
            if isinstance(item, Work):
                item.run()
        t = n * TS
        n += 1
        try:
            answer = plan.send(Sample(t, sp(t), pv(t), 40.0, Mode.AUTOMATIC))
        except StopIteration as end:
            return *end.value, told, t
        except Refused as refused:
            raise Refused(refused.reason, f"{t:.1f}") from refused


def test_what_has_disturbed_it_dies_away() -> None:
    point, trace, told, end = listen(lambda t: SP + (0.5 if t < 0.9 * LOOK_S else 0.0))
    assert point.pv == SP and set(trace.pv) == {SP}
    assert told == ["preflight", "Note", "settle", "preflight"]
    assert end == pytest.approx(3.0 * LOOK_S, abs=1.0)


def test_one_at_rest_is_looked_at_once() -> None:
    _, trace, told, end = listen(lambda t: SP)
    assert told == ["preflight"]
    assert end == pytest.approx(LOOK_S, abs=0.5)
    assert len(trace) == pytest.approx(LOOK_S / TS, abs=3)


def test_patience_ends() -> None:
    with pytest.raises(Refused) as refused:
        listen(lambda t: SP + 0.1 * t)
    assert refused.value.reason is Reason.NOT_AT_REST
    assert float(refused.value.detail) == pytest.approx((2 * MAX_ATTEMPTS - 1) * LOOK_S, abs=2.0)


def test_what_time_does_not_mend_is_refused_at_once() -> None:
    with pytest.raises(Refused) as refused:
        listen(lambda t: SP + (1.0 if round(t / TS) % 2 else -1.0))
    assert refused.value.reason is Reason.NOISE_TOO_HIGH
    assert float(refused.value.detail) == pytest.approx(LOOK_S, abs=0.4)


@pytest.mark.parametrize("every_s", [TS, 1.0], ids=["a ramp", "a slow outer loop"])
def test_a_set_point_that_another_controller_moves_is_refused_at_once(every_s: float) -> None:
    with pytest.raises(Refused) as refused:
        listen(lambda t: SP, lambda t: SP + 1e-4 * int(t / every_s))
    assert refused.value.reason is Reason.SETPOINT_IS_DRIVEN
    assert float(refused.value.detail) == pytest.approx(LOOK_S, abs=0.5)


def test_an_operator_who_moves_the_set_point_is_waited_for() -> None:
    """Twice, in two of the ten parts of the first listening."""
    point, _, told, _ = listen(lambda t: SP + 1e-4, lambda t: SP if t < 0.2 * LOOK_S else SP + 1e-4 * (1 + (t > 4.0)))
    assert point.sp == SP + 2e-4 and told == ["preflight", "Note", "settle", "preflight"]
