"""The simulation in `make test`: 100 seeds (`make simulate` has thousands), one job killed after each of its acts, and
bugs that must be found."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from functools import partial

import pytest

from loopwright.protocol.profile import Mode
from loopwright.service.states.acceptance_watch import AcceptanceWatch, TroubleKind
from loopwright.service.store import watches
from tests.pulse_phases import Phase
from tests.simulation.bugs import BUGS
from tests.simulation.every_call import RESTARTS_S
from tests.simulation.history import Loop, World
from tests.simulation.kinds import KINDS, play, spread, world
from tests.simulation.manual_pulses import STRIKES, struck
from tests.simulation.pool import every_call, run
from tests.simulation.report import tell, words

CORES = os.cpu_count() or 1


@pytest.fixture(autouse=True)
def silent() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.timeout(300)
def test_100_seeds_end_safe() -> None:
    bad = [tell(ending) for ending in run(list(spread(100, list(KINDS))), CORES) if ending.bad]
    assert not bad, "\n".join(bad)


@pytest.mark.timeout(900)  # some two minutes on a machine that is busy with the other lanes
def test_one_job_killed_whenever_it_has_sent_or_stored_something_ends_safe() -> None:
    """`make simulate` kills it at each call of the bus."""
    endings = list(every_call(RESTARTS_S, CORES, that_differ=True))
    assert len(endings) > 350
    bad = [tell(ending) for ending in endings if ending.bad]
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize(("phase", "pulse"), [(Phase.UP, 1), (Phase.BACK, 1), (Phase.UP, 2), (Phase.REST, 2)])
@pytest.mark.parametrize("name", STRIKES)
def test_what_happens_in_a_pulse_ends_in_manual_at_the_output_found(name: str, phase: Phase, pulse: int) -> None:
    world = World("manual pulses", 0, Loop(0.1, 10.0, Mode.MANUAL, 50.0, 50.0, 0.005, True, 100))
    struck(world, phase, pulse, name)
    ending = world.run()
    assert world.struck and not ending.bad, words(ending)
    assert " ".join(ending.jobs[0]) in STRIKES[name][1]
    session = world.controller.device.sessions[0]
    channel = session.channel
    assert (session.is_open, channel.mode, channel.on_trial) == (False, Mode.MANUAL, False)
    assert channel.manual_output == channel.mv == world.plant.mv == 50.0


def test_a_watched_loop_gets_the_old_gains_back_or_a_reason_why_not() -> None:
    """The histories of this kind come to every end that a watch can come to."""
    ends = set()
    for seed in range(30):
        made = world("watched", seed)
        found: list[AcceptanceWatch] = []
        made.at_the_end.append(partial(_take_watches, made, found))
        assert not made.run().bad
        ends |= {(each.trouble and each.trouble.kind, each.trouble and each.trouble.rolled_back) for each in found}
    put_back = {TroubleKind.PV_OUTSIDE_LIMITS, TroubleKind.GROWING_OSCILLATION}
    assert ends >= {(kind, True) for kind in put_back} | {(TroubleKind.PV_OUTSIDE_LIMITS, False), (None, None)}


def _take_watches(made: World, found: list[AcceptanceWatch]) -> None:
    store = made.gateways[0].store
    found.extend(watches.of_jobs(store, [row.id for row in store.seen()]).values())


def test_a_seed_is_one_history() -> None:
    for kind, seed in spread(8, list(KINDS)):
        one, other = (play(kind, seed, keeps_log=True) for _ in range(2))
        assert one.log == other.log, f"{kind} {seed}"
        assert [(each.at, each.text) for each in one.bad] == [(each.at, each.text) for each in other.bad]


FOUND_BY = {
    # To search anew: python -m tests.simulation --seeds 2000 --bug NAME
    "count-is-not-checked": ("stranger", 439),
    "set-point-stays": ("stalls", 1),
    "manual-output-stays": ("manual", 767),
    "hold-keeps-automatic": ("false_pv", 85),
    "hold-is-not-looked-for": ("false_pv", 863),
    "gains-are-not-compared": ("watched", 27),
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
