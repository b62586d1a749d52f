"""The simulation in `make test`: 300 seeds, one job killed at each of its calls, and bugs that must be found."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator

import pytest

from tests.simulation.bugs import BUGS
from tests.simulation.every_call import RESTARTS_S
from tests.simulation.kinds import KINDS, play, spread
from tests.simulation.pool import every_call, run
from tests.simulation.report import tell

CORES = os.cpu_count() or 1


@pytest.fixture(autouse=True)
def silent() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.timeout(300)
def test_300_seeds_end_safe() -> None:
    bad = [tell(ending) for ending in run(list(spread(300, list(KINDS))), CORES) if ending.bad]
    assert not bad, "\n".join(bad)


@pytest.mark.timeout(900)  # some four minutes on a machine that is busy with the other lanes
def test_one_job_killed_at_each_call_of_the_bus_ends_safe() -> None:
    endings = list(every_call(RESTARTS_S, CORES, in_turn=True))
    assert len(endings) > 393
    bad = [tell(ending) for ending in endings if ending.bad]
    assert not bad, "\n".join(bad)


def test_a_seed_is_one_history() -> None:
    for kind, seed in spread(20, list(KINDS)):
        one, other = (play(kind, seed, keeps_log=True) for _ in range(2))
        assert one.log == other.log, f"{kind} {seed}"
        assert [(each.at, each.text) for each in one.bad] == [(each.at, each.text) for each in other.bad]


FOUND_BY = {
    # To search anew: python -m tests.simulation --seeds 2000 --bug NAME
    "count-is-not-checked": ("stranger", 13),
    "set-point-stays": ("stalls", 1),
}


@pytest.mark.parametrize("bug", BUGS)
def test_a_bug_put_in_on_purpose_is_found(bug: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kind, seed = FOUND_BY[bug]
    assert (kind, seed) in list(spread(2000, list(KINDS)))
    assert not play(kind, seed).bad
    BUGS[bug](monkeypatch.setattr)
    assert play(kind, seed).bad


def test_the_bugs_leave_nothing_behind() -> None:
    assert "tests.simulation.bugs" in sys.modules
    assert not play("stalls", 1).bad
