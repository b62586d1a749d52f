"""Moves of the set-point at a limited rate: sample by sample, replaced, home at the end, and where they say nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from loopwright.tuning.experiments.primitives import Directions, Facts
from loopwright.tuning.experiments.ramp import MAX_RAMP_T95, check_ramp, equivalent_step, ramped, too_slow
from loopwright.tuning.experiments.step_limits import not_kept
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, Plan, Sample, SetGains, SetSetpoint
from loopwright.tuning.reasons import Reason, Refused

TS, RATE, REST = 0.5, 0.2, 50.0
FACTS = Facts(TS, 20.0, 0.0, 100.0, 2.0, Gains(1.0, 10.0), sp_rate_max_per_s=RATE)
NEW = Gains(2.0, 8.0)


def moves(samples: int, *at: tuple[int, float], ends: Refused | None = None) -> Plan[str]:
    """A plan that commands these set-points, each after its number of samples."""
    commands: list[Command] = []
    for k in range(samples):
        yield commands
        commands = [SetSetpoint(value) for when, value in at if when == k]
    if ends is not None:
        raise ends
    return "done"


def carried_out(plan: Plan[str], late: int = 0) -> Iterator[float]:
    """The set-point after each sample of a loop on which a command acts so many samples late."""
    waiting: list[float | None] = [None] * late
    sp, items = REST, next(plan)
    for k in range(10_000):
        waiting.append(next((each.value for each in items if isinstance(each, SetSetpoint)), None))
        now = waiting.pop(0)
        sp = sp if now is None else now
        yield sp
        try:
            items = plan.send(Sample(k * TS, sp, sp, 0.0, Mode.AUTOMATIC))
        except StopIteration as end:
            assert end.value == "done"
            return


@pytest.mark.parametrize("late", [0, 3])
def test_the_set_point_moves_no_faster_than_is_permitted_and_goes_home_at_the_end(late: int) -> None:
    found = np.array(list(carried_out(ramped(FACTS, moves(60, (2, REST + 2.0))), late)))
    assert np.abs(np.diff(found)).max() <= RATE * TS + 1e-9
    assert found.max() == REST + 2.0
    assert np.count_nonzero(found > REST + 1.999) > 30, "it stays where the plan wants it"
    assert np.count_nonzero(np.diff(found) > 0.0) == 20, "2 by 0.1 in a sample"
    if not late:
        assert found[-1] == REST


def test_a_new_move_takes_the_place_of_the_one_that_goes_on() -> None:
    found = np.array(list(carried_out(ramped(FACTS, moves(60, (2, REST + 2.0), (12, REST - 1.0))))))
    assert found.max() == pytest.approx(REST + 1.0), "ten samples up, then down at once"
    assert found.min() == REST - 1.0 and found[-1] == REST
    assert np.abs(np.diff(found)).max() <= RATE * TS + 1e-9


def test_other_commands_pass_at_once_and_in_front() -> None:
    plan = ramped(FACTS, (each for each in [(), (SetGains(NEW), SetSetpoint(REST + 1.0)), ()]))  # type: ignore[arg-type]
    assert next(plan) == []
    items = plan.send(Sample(0.0, REST, REST, 0.0, Mode.AUTOMATIC))
    assert items == [SetGains(NEW), SetSetpoint(REST + 0.1)]
    assert plan.send(Sample(TS, REST, REST, 0.0, Mode.AUTOMATIC)) == [SetSetpoint(REST + 0.2)]


def test_without_a_limit_the_plan_is_the_same() -> None:
    free = replace(FACTS, sp_rate_max_per_s=math.inf)
    assert list(carried_out(ramped(free, moves(9, (2, 53.0))))) == list(carried_out(moves(9, (2, 53.0))))


@pytest.mark.parametrize(("reason", "home"), [(Reason.UNCERTAIN, True), (Reason.DIVERGES, False)])
def test_a_refusal_waits_for_the_way_home_unless_the_loop_runs_away(reason: Reason, home: bool) -> None:
    found = []
    with pytest.raises(Refused) as caught:
        for sp in carried_out(ramped(FACTS, moves(60, (2, REST + 2.0), ends=Refused(reason, "")))):
            found.append(sp)
    assert caught.value.reason is reason
    assert (found[-1] == REST) is home


def test_a_ramp_excites_as_a_step_with_the_same_density_at_the_ultimate_frequency() -> None:
    """The Fourier integral of a unit step is 1/(jw) at w; that of the ramp r t, until it ends far later, r/(jw)^2."""
    Pu = 6.0
    w = 2.0 * math.pi / Pu
    assert equivalent_step(FACTS, Pu) / w == pytest.approx(RATE / w**2)


class TestTooSlow:
    def test_a_rate_at_which_nothing_is_seen_is_refused_with_one_that_may_do(self) -> None:
        slow = replace(FACTS, sp_rate_max_per_s=0.02)
        with pytest.raises(Refused) as caught:
            check_ramp(slow, 0.1)
        assert caught.value.reason is Reason.UNCERTAIN
        assert "the set-point takes 100 s for a move by 2" in caught.value.detail
        needed = float(caught.value.detail.split("a rate of ")[1].split()[0])
        check_ramp(replace(FACTS, sp_rate_max_per_s=1.01 * needed), 0.1)
        with pytest.raises(Refused):
            check_ramp(replace(FACTS, sp_rate_max_per_s=0.97 * needed), 0.1)

    def test_without_noise_the_time_alone_counts(self) -> None:
        longest = MAX_RAMP_T95 * FACTS.T95_s
        assert too_slow(replace(FACTS, sp_rate_max_per_s=1.01 * 2.0 / longest), 0.0, 5.0) is None
        found = too_slow(replace(FACTS, sp_rate_max_per_s=0.99 * 2.0 / longest), 0.0, 5.0)
        assert found is not None and "more than 10 T95 (200 s): a rate of 0.01 at least is needed" in found

    def test_a_step_is_never_too_slow(self) -> None:
        assert too_slow(replace(FACTS, sp_rate_max_per_s=math.inf), 0.1, 5.0) is None


@pytest.mark.parametrize(
    ("directions", "rate", "stages", "mirrored", "words"),
    [
        (Directions.BOTH, math.inf, ("baseline", "relay", "ultimate", "zn_pi", "verify"), False, []),
        (Directions.UP, math.inf, ("zn_pi", "verify"), False, []),
        (Directions.DOWN, math.inf, ("verify",), True, []),
        (Directions.DOWN, 0.1, ("preflight", "optimise"), False, []),
        (Directions.UP, math.inf, ("relay", "ultimate"), False, ["by relay and ultimate;"]),
        (Directions.DOWN, math.inf, ("baseline", "verify"), False, ["stepped up by baseline, verify;"]),
        (Directions.BOTH, 0.1, ("relay", "ultimate", "verify"), False, ["measured by ultimate, verify;"]),
        (Directions.UP, 0.1, ("relay", "zn_pi"), False, ["to both sides of its rest by relay;", "measured by zn_pi;"]),
    ],
)
def test_what_steps_cannot_keep(
    directions: Directions, rate: float, stages: tuple[str, ...], mirrored: bool, words: list[str]
) -> None:
    found = not_kept(directions, rate, stages, mirrored)
    assert len(found) == len(words)
    assert all(part in text for part, text in zip(words, found, strict=True))


@pytest.mark.parametrize("rate", [0.0, -1.0, math.nan])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    with pytest.raises(Refused) as caught:
        replace(FACTS, sp_rate_max_per_s=rate)
    assert caught.value.reason is Reason.BAD_INPUT
