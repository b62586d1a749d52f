"""What is kept of what is known of a loop."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from loopwright.service.observing import knowledge
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.results import FastResult, Finding
from loopwright.service.store import knowledge as stored
from loopwright.service.store.store import Store
from tests.unit.service.observing.findings import PRESENT, finding, job

A_JOB = job(FastResult(method="fast"))
Keep = Callable[[Finding], None]


@pytest.fixture
def kept(store: Store) -> KeptKnowledge:
    return KeptKnowledge(store)


@pytest.fixture
def keep(kept: KeptKnowledge, monkeypatch: pytest.MonkeyPatch) -> Keep:
    """Keeps a finding, wherever it is from."""

    def keep(found: Finding) -> None:
        monkeypatch.setattr(knowledge, "of_trial", lambda *_: found)
        kept.accepted(A_JOB)

    return keep


def test_what_is_known_is_kept_however_many_changes_follow_that_know_less(
    kept: KeptKnowledge, keep: Keep, store: Store
) -> None:
    keep(finding(1.30, 0.02, last_change_s=0.0))
    for n in range(1, 2 * stored.MAX_OF_A_LOOP):
        keep(finding(1.31, 0.08, last_change_s=1000.0 * n))
    found = kept.of(A_JOB.loop, PRESENT)
    assert found is not None and (found.Ms, found.uncertainty) == (1.30, 0.02)
    assert found.consistent == stored.MAX_OF_A_LOOP == len(stored.read(store, A_JOB.loop)) - 1


def test_one_that_later_ones_disagree_with_goes(kept: KeptKnowledge, keep: Keep, store: Store) -> None:
    keep(finding(1.30, 0.02, last_change_s=0.0))
    for n in range(1, stored.MAX_OF_A_LOOP + 1):
        keep(finding(1.70, 0.08, last_change_s=1000.0 * n))
    found = kept.of(A_JOB.loop, PRESENT)
    assert found is not None and (found.Ms, found.superseded) == (1.70, None)
    assert len(stored.read(store, A_JOB.loop)) == stored.MAX_OF_A_LOOP
