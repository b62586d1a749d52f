"""Controllers that do not do what their gains say, by relay and by pulses: refused with what they do instead."""

from __future__ import annotations

import pytest

from benchmarks.controllers import PLANTS, measure
from loopwright.tuning.fast.pulses.procedure import SETPOINT
from loopwright.tuning.fast.relay.procedure import FAST


@pytest.mark.parametrize("method", [FAST, SETPOINT])
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("Kp x 1.4", "Kp times 1.4"),
        ("Ti x 0.5", "Ti times 0."),
        ("filter 0.1 Pu", "a filter of PV inside the controller of"),
        ("PID, no derivative filter", "a derivative without its filter"),
    ],
)
def test_it_is_refused_with_what_it_does_instead(kind: str, words: str, method: str) -> None:
    found = measure(PLANTS[1], kind, 1, method)
    assert found.reason == "controller_mismatch" and words in found.detail


@pytest.mark.parametrize(
    ("kind", "words"),
    [("PID, derivative of the error", "a derivative of the error"), ("b = 0", "a set-point weight b")],
)
def test_what_answers_the_set_point_otherwise_shows_where_it_moves(kind: str, words: str) -> None:
    """Under the relay it moves only as the new gains take over: Ms is as asked for, and nothing tells."""
    found = measure(PLANTS[1], kind, 1, SETPOINT)
    assert found.reason == "controller_mismatch" and words in found.detail
    by_relay = measure(PLANTS[1], kind, 1, FAST)
    assert by_relay.reason is None and by_relay.Ms == pytest.approx(1.6, abs=0.02)


@pytest.mark.parametrize("method", [FAST, SETPOINT])
def test_without_the_check_it_is_silently_wrong(method: str) -> None:
    found = measure(PLANTS[1], "Kp x 1.4", 1, method, checked=False)
    assert found.reason is None and found.Ms is not None and found.Ms > 1.85


@pytest.mark.parametrize("method", [FAST, SETPOINT])
@pytest.mark.parametrize("kind", ["as said, another sampling", "MV a sample late", "filter 0.02 Pu"])
def test_what_hardly_changes_Ms_is_proposed(kind: str, method: str) -> None:
    found = measure(PLANTS[1], kind, 1, method)
    assert found.reason is None and found.Ms == pytest.approx(1.6, abs=0.1)
