"""What a finished test leaves as knowledge of its loop: Ms of the gains that the loop has, right on the plant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.rehearsed import TS
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.results import FindingSource, KnowledgeView
from loopwright.service.store.store import Store
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT
from tests.rehearsal import test_fast_jobs
from tests.rehearsal.test_fast_jobs import TAG, K, L, T, proposal

OLD = Gains(0.2, 6.0)


def known(folder: Path, gains: Gains) -> KnowledgeView | None:
    store = Store(folder)
    try:
        return KeptKnowledge(store).of(TAG, gains)
    finally:
        store.close()


def true_Ms(gains: Gains) -> float:
    return margins(FOPDT(K, T, L + TS / 2), gains).Ms


@pytest.mark.parametrize("options", [{}, {"method": "setpoint", "amplitude_pct": None}], ids=["fast", "setpoint"])
def test_a_proposal_tells_Ms_of_the_present_and_of_the_new_gains(
    tmp_path: Path, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(test_fast_jobs, "NOISE", 0.05)
    job, samples = proposal(tmp_path, 0.0, 0.0, **options)
    assert job["state"] == "proposed", job["detail"]
    found = known(tmp_path, OLD)
    assert found is not None and found.source is FindingSource.JOB and found.job == job["url"]
    assert found.Ms is not None and found.uncertainty is not None and 0.0 < found.uncertainty < 0.1
    assert abs(found.Ms - true_Ms(OLD)) < found.uncertainty + 0.005
    assert found.Ms == pytest.approx(job["comparison"]["previous"]["Ms"], abs=0.005)
    assert found.pv_range is not None and found.mv_range is not None
    assert (found.pv_range.low, found.pv_range.high) == pytest.approx(
        (min(samples["pv"]), max(samples["pv"])), abs=1e-4
    )
    assert (found.mv_range.low, found.mv_range.high) == pytest.approx(
        (min(samples["mv"]), max(samples["mv"])), abs=1e-4
    )
    new = Gains(*(job["new_gains"][name] for name in ("Kp", "Ti", "Td", "Tf", "b", "c")))
    accepted = known(tmp_path, new)
    assert accepted is not None and accepted.proposed is None and accepted.uncertainty is not None
    assert accepted.Ms == pytest.approx(true_Ms(new), abs=accepted.uncertainty + 0.01)


def test_a_trial_of_a_model_that_somebody_typed_in_tells_nothing(tmp_path: Path) -> None:
    model = {"num": [K], "den": [T, 1.0], "dead_time_s": L}
    job, _ = proposal(tmp_path, 0.0, 0.0, amplitude_pct=None, start="design", model=model, Ms=1.4)
    assert job["state"] == "proposed" and known(tmp_path, OLD) is None
