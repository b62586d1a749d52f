"""The composition root of the jobs: it makes every part once, and passes each the parts that it needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from loopwright.service.execution.procedures import Rehearse, Tune
from loopwright.service.inputs.config import BusConfig, LoopConfig
from loopwright.service.jobs.aftercare import Aftercare
from loopwright.service.jobs.decisions import Decisions
from loopwright.service.jobs.engine import Engine
from loopwright.service.jobs.forwarded_decisions import ForwardedDecisions
from loopwright.service.jobs.journal import Journal
from loopwright.service.jobs.locking import Locking
from loopwright.service.jobs.loop_directory import LoopDirectory, LoopFactory
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.manager import Jobs
from loopwright.service.jobs.operation import OperationKnowledge
from loopwright.service.jobs.recovery import Recovery
from loopwright.service.jobs.registry import Registry
from loopwright.service.jobs.requested_decisions import RequestedDecisions
from loopwright.service.jobs.worker import Worker
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.store.decision_requests import What
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store


def make_jobs(
    loops: Mapping[str, LoopConfig],
    store: Store,
    open_loop: LoopFactory,
    tune: Tune,
    rehearse: Rehearse,
    *,
    engine: Engine,
    buses: Mapping[str, BusConfig] | None = None,
    resume: bool = True,
    machine: Machine | None = None,
    ended: Callable[[Job], None] = lambda job: None,
) -> Jobs:
    """Makes the jobs of this host's loops, without starting them.

    buses: the configuration of their buses.
    resume: whether jobs of a dead service are resumed at the next start.
    machine: clock and threads.
    ended: called with each job at its end, when its loop is restored; it returns at once.
    """
    machine = machine or Machine()
    registry = Registry()
    journal = Journal(store, beside=machine.writes_beside)
    directory = LoopDirectory(loops, store, open_loop, registry, machine, buses)
    knowledge = KeptKnowledge(store, machine.lock())
    operation = OperationKnowledge(store, directory, knowledge)
    forwarded_decisions = ForwardedDecisions(store, machine)
    decisions = Decisions(store, directory, machine, knowledge, forwarded_decisions)
    locking = Locking(store, directory, decisions, forwarded_decisions)
    requested_decisions = RequestedDecisions(
        store,
        machine,
        registry,
        {
            What.ACCEPT: lambda asked: decisions.accept(asked.job_id or "", asked.by, asked.auto_rollback is not False),
            What.ROLLBACK: lambda asked: decisions.rollback(asked.job_id or "", asked.by),
            What.WRITES_OVER: lambda asked: locking.wait_for_writes(asked.loop),
        },
    )
    return Jobs(
        store=store,
        engine=engine,
        journal=journal,
        registry=registry,
        directory=directory,
        worker=Worker(store, journal, directory, registry, tune, rehearse, machine, knowledge, operation, ended),
        decisions=decisions,
        locking=locking,
        requested_decisions=requested_decisions,
        aftercare=Aftercare(store, directory, machine),
        recovery=Recovery(loops, store, open_loop, resume, lambda: registry.stopping),
        machine=machine,
        knowledge=knowledge,
        operation=operation,
    )
