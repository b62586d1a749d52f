"""Jobs of fast whose plant is known from operation: cut off by the end of their service, and where it is known no
more."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.rehearsed import TS, entry, open_loop
from loopwright.service.execution.procedures import rehearse, tune
from loopwright.service.inputs.config import parse_site
from loopwright.service.inputs.request import BadLimits, FastRetune, retune_request, within
from loopwright.service.jobs.manager import Jobs
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store import job_knowledge, knowledge
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from loopwright.tuning.operation.known import known_plant
from loopwright.tuning.operation.observation import observe
from tests.rehearsal.test_observe import ASKED, operated
from tests.rehearsal.test_resumed_jobs import COMPUTED_WITHIN_S, TAG, Mortal, MortalEngine
from tests.unit.service.observing.findings import finding

PLANT = FOPDT(2.0, 6.0, 1.5)
LOOPS = parse_site({"loops": [entry(TAG) | {"test": {"excitations": ["observe", "setpoint"]}}]}, "test").loops


@cache
def shown(plant: FOPDT) -> ObservedPlant:
    """What operation has shown of a plant, around MV 50."""
    sp = np.repeat([0.0, 1.6, -0.6, 1.2, 0.0, 1.4, 0.2], round(120.0 / TS))
    known = known_plant(observe([operated(plant, Gains(0.2, 6.0), sp, Ts=TS)], True, ASKED), TS, 60.0)
    assert isinstance(known, ObservedPlant), known
    return replace(known, mv=(known.mv[0] + 50.0, known.mv[1] + 50.0))


class Ran:
    """A service on a folder that runs one job, or goes on with it. known: what operation shows when it is asked.
    dies_in: the stage in which it dies."""

    def __init__(self, folder: Path, known: ObservedPlant | NothingKnown, dies_in: str | None = None) -> None:
        self.store, self.engine, self.asked = Store(folder), MortalEngine(), 0
        samples = [0]

        def dies() -> bool:
            running = list(self.jobs.registry.running.values())
            samples[0] += bool(running and running[0].progress.stage == dies_in)
            return samples[0] > 20

        def heard(*_: object) -> ObservedPlant | NothingKnown:
            self.asked += 1
            return known

        self.jobs: Jobs = make_jobs(
            LOOPS, self.store, lambda config: Mortal(open_loop(config), dies), tune, rehearse, engine=self.engine
        )
        vars(self.jobs.operation)["_heard"] = heard

    def begins(self, **options: object) -> None:
        self.jobs.boot()
        self.jobs.start(TAG, retune_request(**options))

    def dead(self) -> None:
        assert self.engine.dead.wait(COMPUTED_WITHIN_S) and self.jobs.journal.flush(10)
        self.jobs.stop_watching()
        self.store.close()

    def finished(self) -> tuple[Job, list[str]]:
        self.engine.join(COMPUTED_WITHIN_S)
        row = self.store.recent()[0]
        ran = [begun.stage for event in self.store.events(row.id) if (begun := event.stage_begun())]
        self.jobs.stop()
        return row, ran


def test_a_job_cut_off_in_its_trial_begins_with_the_same_knowledge(tmp_path: Path) -> None:
    first = Ran(tmp_path, shown(PLANT), dies_in="trial")
    first.begins()
    first.dead()
    again = Ran(tmp_path, NothingKnown("after a restart nothing is in memory"))
    again.jobs.boot()
    row, ran = again.finished()
    assert (row.state, row.attempt) == ("proposed", 2), row.detail
    assert (first.asked, again.asked) == (1, 0)
    assert ran == ["preflight", "design", "trial", "settle", "preflight", "design", "trial", "redesign"]
    assert row.result is not None and row.result.new_gains is not None
    assert getattr(row.result, "model_from", "").startswith("6 set-point changes of normal operation")
    assert row.restored is not None and row.restored["on_trial"] is False
    again.store.close()


def test_a_trial_that_shows_another_plant_drops_what_operation_has_shown(tmp_path: Path) -> None:
    here = Ran(tmp_path, shown(replace(PLANT, K=1.0)))
    knowledge.add(here.store, TAG, finding(), {})
    here.begins()
    row, ran = here.finished()
    assert row.state == "proposed", row.detail
    assert "trial" in ran and ran.index("pulses") > ran.index("trial")
    older = [each.superseded for each in knowledge.read(here.store, TAG)]
    assert older[0] is not None and f"job {row.id} has tried gains from operation" in older[0]
    assert older[1:] == [None], "what the pulses have found is known now"
    assert job_knowledge.outdated_until_s(here.store, TAG) is not None
    here.store.close()


def test_after_a_trial_that_showed_another_plant_a_resumed_job_begins_with_pulses(tmp_path: Path) -> None:
    first = Ran(tmp_path, shown(replace(PLANT, K=1.0)), dies_in="pulses")
    first.begins()
    first.dead()
    again = Ran(tmp_path, NothingKnown("not asked"))
    again.jobs.boot()
    row, ran = again.finished()
    assert row.state == "proposed" and ran.count("trial") == 1, row.detail
    assert again.asked == 0
    again.store.close()


@pytest.mark.parametrize("options", [{"excitations": ["setpoint"]}, {"method": "setpoint"}, {"dry_run": True}])
def test_what_begins_otherwise_does_not_ask(tmp_path: Path, options: dict[str, object]) -> None:
    here = Ran(tmp_path, NothingKnown("-"))
    here.begins(**options)
    row, ran = here.finished()
    assert here.asked == 0 and "trial" not in ran and row.state in ("proposed", "rehearsed"), row.detail
    here.store.close()


def test_the_step_alone_cannot_be_left_out_where_nothing_else_is_permitted() -> None:
    request = retune_request(excitations=["observe"], verify=False)
    assert isinstance(request, FastRetune)
    with pytest.raises(BadLimits, match="only after the step under them; leave verify out"):
        within(LOOPS[TAG], request)
