"""The service looks at the history of its loops by itself: when, how often, and what it leaves."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.history_observer import CHECK_S, LOOK_EVERY_S, HistoryObserver
from loopwright.service.listening.rings import Rings
from loopwright.service.store import knowledge
from loopwright.tuning.reasons import Reason
from tests.unit.service.fakes import TAG, Service
from tests.unit.service.observing.operated import HeardBefore, Operated

LOOP = Operated()
MOVES: dict[int, float] = {1000: 1.0, 1900: -0.8, 2800: 0.9}


class OneLoop(HeardBefore):
    """What was heard of TIC-101; of FIC-2 nothing was."""

    rings: Rings
    off: dict[str, str] = {}

    def history(self, tag: str, from_s: float, to_s: float, points: int) -> Any:
        return HeardBefore(self.rings if tag == TAG else Rings()).history(tag, from_s, to_s, points)


class PoolInThisProcess:
    """Runs computations at once. meanwhile: called before the first check whether the result is wanted."""

    def __init__(self) -> None:
        self.kinds: list[ComputationKind] = []
        self.meanwhile: Callable[[], None] = lambda: None

    def run(self, kind: ComputationKind, work: Callable[[], Any], *, unwanted: Callable[[], bool]) -> Any:
        self.kinds.append(kind)
        self.meanwhile()
        if unwanted():
            raise NotWanted
        return work()


class Looked:
    """A service whose history is looked at, with a clock of its own."""

    def __init__(self, service: Service, moves: dict[int, float], loop: Operated = LOOP, samples: int = 3800) -> None:
        self.service, self.now_s, self.pool = service, time.time(), PoolInThisProcess()
        self.loop, self.moves, self.samples = loop, moves, samples
        service.controller.state = replace(service.controller.state, gains=loop.gains, sample_time_s=loop.Ts)
        self.listening = OneLoop(Rings())
        self.goes_on(0.0)
        jobs = service.jobs
        self.looking = HistoryObserver(
            jobs.directory, jobs.registry, service.store, self.listening, jobs.knowledge, self.pool,
            wall=lambda: self.now_s,
        )  # type: ignore[arg-type]  # fmt: skip

    def goes_on(self, seconds: float, moves: dict[int, float] | None = None) -> None:
        """Operation goes on. moves: changes of the set-point, by sample from now on."""
        self.now_s += seconds
        self.moves |= {self.samples + n: size for n, size in (moves or {}).items()}
        self.samples += round(seconds / self.loop.Ts)
        self.listening.rings = self.loop.heard(self.moves, self.samples, self.now_s)

    def found(self) -> list[int | None]:
        return [each.finding.changes for each in knowledge.read(self.service.store, TAG)]


def test_changes_of_operators_are_looked_at_once_and_known(service: Service) -> None:
    here = Looked(service, dict(MOVES))
    before = service.controller.state
    assert here.looking.look_at_due_loops() == [TAG] and here.found() == [3]
    assert here.pool.kinds == [ComputationKind.LOOK] and service.controller.state == before
    assert not service.controller.session and service.controller.open == 0
    here.goes_on(2.0 * LOOK_EVERY_S)
    assert here.looking.look_at_due_loops() == [], "operation goes on, and nobody moved the set-point"
    here.goes_on(LOOK_EVERY_S, {4000: 0.5})
    assert here.looking.look_at_due_loops() == [TAG] and here.pool.kinds == 2 * [ComputationKind.LOOK]


def test_a_loop_that_is_not_heard_is_not_looked_at(service: Service) -> None:
    here = Looked(service, dict(MOVES))
    here.listening.off = dict.fromkeys({loop.bus for loop in service.jobs.directory.loops.values()}, "off")
    assert here.looking.look_at_due_loops() == []


def test_the_looks_of_all_loops_ask_once_which_have_a_job(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    here, asked = Looked(service, dict(MOVES)), list[str]()
    busy = service.store.busy
    monkeypatch.setattr(service.store, "busy", lambda: asked.append("") or busy())
    here.looking.look_at_due_loops()
    assert len(asked) == 1 and len(service.jobs.directory.loops) > 1
    here.looking.look_at_due_loops()
    assert len(asked) == 1, "no loop is due"


def test_a_change_is_looked_at_when_it_has_been_followed(service: Service) -> None:
    here = Looked(service, {3750: 1.0})
    assert here.looking.look_at_due_loops() == [], "5 s ago"
    here.goes_on(30.0)
    assert here.looking.look_at_due_loops() == [], "not checked again as yet"
    here.goes_on(CHECK_S)
    assert here.looking.look_at_due_loops() == [TAG]
    assert here.found() == [], "one change alone is no answer"


def test_a_clock_that_was_put_back_does_not_end_the_looks(service: Service) -> None:
    here = Looked(service, dict(MOVES))
    assert here.looking.look_at_due_loops() == [TAG]
    here.now_s -= 86_400.0
    here.goes_on(2.0 * LOOK_EVERY_S, {4000: 0.5, 4900: -0.7})
    assert here.looking.look_at_due_loops() == [TAG]


@pytest.mark.parametrize("sample_time_s, looks", [(0.1, False), (0.02, True)])
def test_the_next_look_comes_before_the_samples_are_gone(
    service: Service, monkeypatch: pytest.MonkeyPatch, sample_time_s: float, looks: bool
) -> None:
    """Twelve thousand samples are in memory: of 20 ms they last for 4 min."""
    here = Looked(service, {1000: 1.0}, loop=Operated(L=0.5, Ts=sample_time_s), samples=8000)
    monkeypatch.setattr(here.looking, "_look", lambda config: True)
    assert here.looking.look_at_due_loops() == [TAG]
    here.goes_on(125.0, {2000: 1.0})
    assert here.looking.look_at_due_loops() == ([TAG] if looks else [])
    here.goes_on(LOOK_EVERY_S)
    assert here.looking.look_at_due_loops() == ([] if looks else [TAG])


def test_a_loop_under_test_is_not_looked_at(service: Service) -> None:
    here = Looked(service, dict(MOVES))
    service.tune.hold.clear()

    def tested() -> None:
        service.jobs.start(TAG, FastRetune())
        assert service.tune.inside.wait(60)

    here.pool.meanwhile = tested
    assert here.looking.look_at_due_loops() == [] and here.found() == [], "the look was ended as the test began"
    here.pool.meanwhile = lambda: None
    here.goes_on(LOOK_EVERY_S)
    assert here.looking.look_at_due_loops() == [] and len(here.pool.kinds) == 1
    service.tune.hold.set()
    service.wait(service.store.recent()[0].id)
    here.goes_on(CHECK_S)
    assert here.looking.look_at_due_loops() == [TAG], "the changes were not looked at yet"


@pytest.mark.parametrize("why", ["no change", "remote", "silent"])
def test_what_is_not_looked_at(service: Service, why: str) -> None:
    here = Looked(service, {} if why == "no change" else dict(MOVES))
    if why == "remote":
        service.loops[TAG] = service.loops[TAG].model_copy(update={"setpoint_from": "remote"})
    if why == "silent":
        service.controller.absent = Reason.NODE_LOST
    assert here.looking.look_at_due_loops() == [] and here.pool.kinds == []
