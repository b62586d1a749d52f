from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from loopwright.service.store.clock_watch import ClockWatch, Seen, after_a_stop, in_operation, longest_stop

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
DAY = timedelta(days=1)


@pytest.mark.parametrize(
    ("keep_days", "days"), [(None, 31.0), (0.5, 1.0), (1.0, 1.0), (30.0, 15.0), (365.0, 31.0), (1e12, 31.0)]
)
def test_a_stop_of_half_the_time_is_believed(keep_days: float | None, days: float) -> None:
    assert longest_stop(keep_days) == timedelta(days=days)


@pytest.mark.parametrize("away", [-0.005, 0.0, 0.3, 6.9])
def test_after_a_stop_ages_count_as_before(away: float) -> None:
    seen, jump = after_a_stop(Seen(NOW, NOW - 90 * DAY), NOW + away * DAY, 7 * DAY)
    assert jump is None and seen == Seen(NOW + away * DAY, NOW - 90 * DAY)


@pytest.mark.parametrize(("by", "words"), [(365.0, "forward by 358 days"), (7.5, "forward by 12.0 h"), (-1.0, "back")])
def test_a_clock_that_jumped_over_a_stop(by: float, words: str) -> None:
    at = NOW + by * DAY
    seen, jump = after_a_stop(Seen(NOW), at, 7 * DAY)
    assert jump is not None and words in jump.text and seen == Seen(at, at)


@pytest.mark.parametrize("by", [timedelta(minutes=11), timedelta(minutes=-11), 365 * DAY, -365 * DAY])
def test_a_clock_that_jumps_in_operation(by: timedelta) -> None:
    seen, jump = in_operation(Seen(NOW), NOW + by, NOW)
    assert jump is not None and seen == Seen(NOW + by, NOW + by)


def test_a_clock_that_is_put_right_has_not_jumped() -> None:
    for by in (timedelta(minutes=9), timedelta(minutes=-9)):
        assert in_operation(Seen(NOW), NOW + by, NOW) == (Seen(NOW + by), None)


def test_many_small_steps_are_a_jump_too() -> None:
    """Each look is compared with the first one, not with the one before it."""
    wall, passed_s = NOW, 0.0
    watch = ClockWatch(lambda: wall, lambda: passed_s)
    assert watch.look(None, DAY) is None and watch.seen == Seen(NOW)
    jumps = 0
    for _ in range(10):
        wall, passed_s = wall + timedelta(minutes=5), passed_s + 60.0
        jumps += watch.look(None, DAY) is not None
    assert jumps == 3
    wall, passed_s = wall + 400 * DAY, passed_s + 400 * 86400.0  # suspended, and awake again
    assert watch.look(None, DAY) is None
