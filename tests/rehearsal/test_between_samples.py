"""What the thread of a loop computes between two samples: little, because the lease is renewed between them.

The work is counted in function calls, which do not depend on the machine. Computations that a plan hands out as `Work`
are not counted: the service carries them out in another process.
"""

from __future__ import annotations

import sys
from collections.abc import Generator
from types import FrameType
from typing import Any

import pytest

from loopwright.service.execution import rehearsal
from loopwright.service.execution.runner import run
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.plan import Plan, StageStarted

MAX_CALLS = 12_000
"""About 12 ms of processor time. The robust optimisation makes 34,000 calls, and took three seconds in a service under
attack: the lease was used up."""
PLANT: dict[str, Any] = {"num": [1.0], "den": [5.0, 1.0], "dead_time_s": 2.0, "noise_std": 0.002, "sample_time_s": 0.1}


def counted(plan: Plan[Any], calls: dict[str, int]) -> Generator[Any, Any, Any]:
    """The plan, with the largest number of function calls between two of its samples by stage."""
    made, stage, sample = 0, "preflight", None

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal made
        made += event in ("call", "c_call")

    while True:
        made = 0
        before = sys.getprofile()
        sys.setprofile(count)
        try:
            answer = next(plan) if sample is None else plan.send(sample)
        except StopIteration as end:
            return end.value
        finally:
            sys.setprofile(before)
            calls[stage] = max(calls.get(stage, 0), made)
        stage = next((each.stage for each in answer if isinstance(each, StageStarted)), stage)
        sample = yield answer


@pytest.mark.parametrize(
    "asked",
    [
        {"method": "five-stage"},
        {"method": "five-stage", "baseline": True},
        {"method": "simc"},
        {"method": "fast"},
        {"method": "setpoint"},
        {"method": "fast", "excitations": (Excitation.MANUAL,)},
    ],
    ids=str,
)
def test_little_is_computed_between_two_samples(asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    calls: dict[str, int] = {}
    monkeypatch.setattr(rehearsal, "run", lambda plan, *args, **more: run(counted(plan, calls), *args, **more))
    assert rehearsal.rehearse(PLANT, **asked).ended is None
    assert len(calls) > 2 and max(calls.values()) < MAX_CALLS, calls
