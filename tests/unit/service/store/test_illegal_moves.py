"""What is said to a request that comes too late: what is there, since when, by whom, what to do next."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from loopwright.service.inputs.request import FastRetune
from loopwright.service.states.job_state import MOVES, IllegalMove, JobState
from loopwright.service.store import illegal_moves
from loopwright.service.store.illegal_moves import Decided
from loopwright.service.store.tables import JobRow
from loopwright.tuning.reasons import Reason
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.fakes import TAG, Service

BEGUN, ENDED, AT = "2026-01-31T12:00:00.000Z", "2026-01-31T12:10:00.000Z", "2026-01-31T12:20:00.000Z"


def job(state: JobState, **changes: object) -> JobRow:
    return JobRow(
        id="4f0c", loop="TIC-101", state=state, by="A. Lind", created_at=BEGUN, started_at=BEGUN,
        ended_at=ENDED, **changes,
    )  # fmt: skip


def words(now: JobState, wanted: JobState, **changes: object) -> str:
    decided = Decided("B. Berg", AT) if now in (JobState.ACCEPTED, JobState.ROLLED_BACK) else None
    return str(illegal_moves.too_late(job(now, **changes), now, wanted, decided))


@pytest.mark.parametrize(("state", "changes", "said"), [
    (JobState.RUNNING, {"stage": "relay"}, "loop TIC-101 is busy with job 4f0c of A. Lind, under way since "
     f"{BEGUN} (stage relay): wait for its end, or abort it, then ask again"),
    (JobState.QUEUED, {}, "loop TIC-101 is busy with job 4f0c of A. Lind, waiting for its turn since "
     f"{BEGUN}: wait for its end, or abort it, then ask again"),
    (JobState.RUNNING, {"stop_reason": Reason.OPERATOR},
     "loop TIC-101 is busy with job 4f0c of A. Lind, which is being stopped: ask again in a moment"),
])  # fmt: skip
def test_a_loop_that_a_job_has(state: JobState, changes: dict[str, object], said: str) -> None:
    assert illegal_moves.busy(job(state, **changes)) == said


@pytest.mark.parametrize(("now", "wanted", "said"), [
    (JobState.ACCEPTED, JobState.ACCEPTED, f"job 4f0c was accepted by B. Berg at {AT}: its gains are written already. "
     "To go back to the previous gains, roll it back"),
    (JobState.ROLLED_BACK, JobState.ACCEPTED, f"job 4f0c was rolled back by B. Berg at {AT}: its gains can be written "
     "no more. For new ones, retune the loop"),
    (JobState.ACCEPTED, JobState.ABORTED, f"job 4f0c was accepted by B. Berg at {AT}: nothing runs that could be "
     "stopped. To go back to the previous gains, roll it back"),
    (JobState.PROPOSED, JobState.ABORTED, f"job 4f0c ended at {ENDED} as proposed: nothing runs that could be "
     "stopped. Accept its proposal, or roll it back"),
    (JobState.QUEUED, JobState.ACCEPTED, f"job 4f0c of A. Lind has been waiting for its turn since {BEGUN}: there are "
     "no gains to decide about yet. Wait for its end, or abort it"),
])  # fmt: skip
def test_a_decision_that_comes_late(now: JobState, wanted: JobState, said: str) -> None:
    assert words(now, wanted) == said


def test_a_job_without_a_proposal() -> None:
    said = words(JobState.REFUSED, JobState.ACCEPTED, reason=Reason.NOT_AT_REST)
    assert said.startswith(f"job 4f0c ended at {ENDED} as refused (not at rest): it proposes no gains.")
    assert "retune the loop with propose_anyway" in words(JobState.NO_GAIN, JobState.ACCEPTED)
    assert "retune the loop without dry_run" in words(JobState.REHEARSED, JobState.ACCEPTED)


@pytest.mark.parametrize("now", list(JobState))
@pytest.mark.parametrize("wanted", [JobState.ACCEPTED, JobState.ROLLED_BACK, JobState.ABORTED])
def test_every_request_that_is_refused_has_a_time_and_a_sentence(now: JobState, wanted: JobState) -> None:
    if wanted in MOVES[now]:
        return
    said = words(now, wanted)
    assert any(time in said for time in (BEGUN, ENDED, AT)) and ": " in said and "None" not in said


def problem_of(service: Service, path: str) -> str:
    from fastapi.testclient import TestClient

    from tests.unit.service.apps import app_of

    answer = TestClient(app_of(service.jobs, checks={})).post(path, json={"by": "me"})
    return str(assert_problem(answer, 409)["detail"])


def test_over_rest(service: Service) -> None:
    service.tune.hold.clear()
    row = service.jobs.start(TAG, FastRetune(by="A. Lind"))
    assert service.tune.inside.wait(60)
    busy = problem_of(service, f"/loops/{TAG}/retune")
    assert busy.startswith(f"loop {TAG} is busy with job {row.id} of A. Lind, under way since 20")
    assert "no gains to decide about yet" in problem_of(service, f"/jobs/{row.id}/accept")
    service.tune.hold.set()
    service.wait(row.id)
    service.jobs.decisions.accept(row.id, "B. Berg")
    assert f"job {row.id} was accepted by B. Berg at 20" in problem_of(service, f"/jobs/{row.id}/accept")
    service.jobs.decisions.rollback(row.id, "C. Dahl")
    for what in ("accept", "rollback", "abort"):
        assert f"job {row.id} was rolled back by C. Dahl at 20" in problem_of(service, f"/jobs/{row.id}/{what}")


def test_whoever_is_slower_by_a_moment_is_told_of_the_other(service: Service) -> None:
    row = service.jobs.start(TAG, FastRetune())
    service.wait(row.id)
    service.store.decline(row.id, "B. Berg")
    late_ones: list[Callable[[], object]] = [
        lambda: service.store.begin_decision(row.id, JobState.ACCEPTED, "A. Lind"),
        lambda: service.store.move(row.id, JobState.ACCEPTED, by="A. Lind"),
    ]
    for request in late_ones:
        with pytest.raises(IllegalMove, match=r"was rolled back by B\. Berg at 20"):
            request()
