"""What normal operation has shown of a loop, asked for as a job begins, and kept with the job."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial

from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.listening.listening import Listening
from loopwright.service.observing.hearing import question
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.observing.observed import observed_plant
from loopwright.service.observing.packed_plant import pack, unpack
from loopwright.service.store import job_knowledge
from loopwright.service.store.jobs import Job, JobEvent
from loopwright.service.store.store import Store
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.fast.known_plant.procedure import TRIAL
from loopwright.tuning.reasons import Ended

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ObservationMeans:
    """What hears the loops, and what computes."""

    listening: Listening
    pool: Pool


class OperationKnowledge:
    """What normal operation has shown of the loops of this host.

    wall: the wall clock, s since 1970 UTC, and so the clock of the history.
    """

    def __init__(
        self,
        store: Store,
        directory: LoopDirectory,
        knowledge: KeptKnowledge,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._store, self._directory, self._knowledge, self._wall = store, directory, knowledge, wall
        self._means: ObservationMeans | None = None

    def connect(self, listening: Listening, pool: Pool) -> None:
        """Gives it the listening and the processes that compute; until then nothing is known."""
        self._means = ObservationMeans(listening, pool)

    def known(
        self, job: Job, config: LoopConfig, spec: DesignSpec, unwanted: Callable[[], bool]
    ) -> ObservedPlant | NothingKnown:
        """Returns what is known of the plant as the job begins; of a resumed job, what was known as it began. Takes
        seconds. Raises SQLAlchemyError.

        unwanted: asked several times a second; when it returns True, the computation is ended.
        """
        stored = job_knowledge.kept(self._store, job.id)
        if stored is not None:
            return unpack(stored)
        found = self._heard(config, spec, unwanted)
        job_knowledge.keep(self._store, job.id, job.loop, pack(found))
        return found

    def _heard(
        self, config: LoopConfig, spec: DesignSpec, unwanted: Callable[[], bool]
    ) -> ObservedPlant | NothingKnown:
        if self._means is None:
            return NothingKnown("the service does not listen to its loops")
        listening, pool = self._means.listening, self._means.pool
        try:
            state = self._directory.read(config.tag)
            disturbers = self._directory.disturbers(config.tag)
            asked = question(listening, self._store, config, state, spec, disturbers, self._wall)
            view, found = pool.run(
                ComputationKind.TUNING, partial(observed_plant, asked, self._wall()), unwanted=unwanted
            )
        except NotWanted:
            return NothingKnown("the job was stopped")
        except Ended as ended:
            return NothingKnown(f"the history of the loop could not be looked at: {ended.detail}")
        self._knowledge.observed(view, spec.Ms, state.sample_time_s)
        return found

    def outdated(self, job: Job, events: Sequence[JobEvent]) -> None:
        """Drops what was known from operation, where the trial of a finished job has shown another plant. Raises
        SQLAlchemyError."""
        why = outdated_by(events)
        if why is None:
            return
        log.info("what operation has shown of %s is of an older plant: %s", job.loop, why)
        job_knowledge.outdated(self._store, job.id, datetime.fromtimestamp(self._wall(), UTC))
        self._knowledge.outdated(job, why)


def outdated_by(events: Sequence[JobEvent]) -> str | None:
    """Returns why the known plant is not the present one, by the trial among the events of a job; None where no trial
    says so."""
    for event in reversed(events):
        done = event.stage_ended()
        if done is not None and done.stage == TRIAL and done.result is not None:
            why = done.result.get("outdated")
            return None if why is None else str(why)
    return None
