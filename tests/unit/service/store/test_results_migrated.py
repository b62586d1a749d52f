"""A database of the time before results had one vocabulary: opened now, it shows the figures that it showed then.

tests/data/jobs-before-0009.sql holds jobs of both procedures, of a rule, dry runs, refusals and one without a gain, of
the version of revision 0008; two of them have evidence, and one its reason, in the words of still earlier versions
(`cause`, `surprise`). jobs-before-0009.json holds what `GET /jobs/{id}` showed, with `reason`, `model_mismatch`.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import MetaData, Table, create_engine, insert, select, text

from loopwright.service.api.job_views import job_view
from loopwright.service.results import FastResult, FiveStageResult
from loopwright.service.store import retunes
from loopwright.service.store.database import FILE
from loopwright.service.store.store import Store
from loopwright.tuning.reasons import ADVICE, Reason
from tests.unit.service.postgres import Server
from tests.unit.service.store.test_store import migrate

DATA = Path(__file__).parents[3] / "data"
GOLDEN: dict[str, Any] = json.loads((DATA / "jobs-before-0009.json").read_text())
SQL = (DATA / "jobs-before-0009.sql").read_text()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    folder = tmp_path_factory.mktemp("old")
    for name in (FILE, "old.sqlite"):
        connection = sqlite3.connect(folder / name)
        connection.executescript(SQL)
        connection.close()
    store = Store(folder)
    yield store
    store.close()


def with_later_fields(golden: dict[str, Any]) -> dict[str, Any]:
    """The golden job with what is shown of it since: nobody has decided, a live test knows how fast it sampled, in
    which mode it found the loop, and whether its gains were tried; it has no samples. How late a second path would have
    shown is not known. Gains were tried with b = 1.
    No settling time and no movement of MV were asked for, nor was the latter computed, nor a delay margin.
    Its advice is not stored, but today's for its reason."""
    advice = None if golden["reason"] is None else ADVICE[Reason(golden["reason"])]
    sample_time_s = None if golden["dry_run"] else 0.1
    proposed_live = not golden["dry_run"] and golden["new_gains"] is not None
    tried = bool(golden["after"] or golden["verification"]) if proposed_live else None
    model = golden["model"]
    if model is not None and "num" in model:
        model = model | {"covariance": None, "integrating": False}
    verification = golden["verification"] and golden["verification"] | {"b": 1.0}
    return golden | {
        "comparison": golden["comparison"] and _compared(golden["comparison"]),
        "model": model,
        "watch": None,
        "advice": advice,
        "verification": verification,
        "decided": None,
        "decision_request": None,
        "superseded_by": None,
        "stopping": None,
        "model_from": None,
        "sample_time_s": sample_time_s,
        "mode_found": None if golden["dry_run"] else "automatic",
        "tried": tried,
        "record": "none",
        "remaining_wall_time_s": 0.0,
        "evidence": golden["evidence"] and {**golden["evidence"], "longest_delay_seen_s": None},
    }


def _compared(comparison: dict[str, Any]) -> dict[str, Any]:
    def loop(found: dict[str, Any]) -> dict[str, Any]:
        found = found | {"delay_margin_s": None}
        return found | {step: found[step] and {**found[step], "mv_peak": None} for step in ("setpoint", "load")}

    asked = {"settling_s_asked": None, "mv_peak_asked": None, "noise_gain_asked": None}
    return comparison | asked | {"before": loop(comparison["before"]), "after": loop(comparison["after"])}


def shown(store: Store, job_id: str) -> dict[str, Any]:
    """Without its links, which are no figures."""
    return job_view(store.get(job_id), store.events(job_id), None).model_dump(mode="json", exclude={"links"})


@pytest.mark.parametrize("name", GOLDEN["jobs"])
def test_every_figure_is_shown_as_before(store: Store, name: str) -> None:
    golden = GOLDEN["jobs"][name]
    assert shown(store, golden["id"]) == with_later_fields(golden)


def test_the_old_database_has_what_the_migration_is_about() -> None:
    jobs = GOLDEN["jobs"].values()
    assert "surprise" in SQL and '"cause"' in SQL and "model_mismatch" not in SQL and "'0008'" in SQL
    assert {job["state"] for job in jobs} == {"proposed", "rehearsed", "refused", "no_gain"}
    assert {job["method"] for job in jobs} == {"fast", "five-stage", "simc"}
    for name in ("before", "after", "evidence", "verification", "comparison", "ultimate", "predicted_before"):
        assert any(job[name] for job in jobs), name


def test_the_reasons_of_the_loops_of_a_retune_have_the_words_of_today(store: Store) -> None:
    with store.reading() as session:
        parts = retunes.parts(session, GOLDEN["retune"]["id"])
    assert [part.reason for part in parts] == [part["reason"] for part in GOLDEN["retune"]["loops"]]
    assert "model_mismatch" in [part.reason for part in parts]


def test_results_are_stored_under_the_names_that_are_shown(store: Store) -> None:
    for job in GOLDEN["jobs"].values():
        with store.engine.connect() as connection:
            stored = connection.execute(text("SELECT result FROM jobs WHERE id = :id"), {"id": job["id"]}).scalar_one()
        if stored is None:
            continue
        names = json.loads(stored)
        result = store.get(job["id"]).result
        assert isinstance(result, FastResult if job["method"] == "fast" else FiveStageResult)
        assert names["procedure"] == result.procedure
        assert not names.keys() & {"gains", "baseline", "found", "verified"}
        for name in ("new_gains", "model", "comparison"):
            assert (names.get(name) is None) == (job[name] is None), name


def test_events_have_the_words_of_today(store: Store) -> None:
    words = [json.dumps(event.data) for job in GOLDEN["jobs"].values() for event in store.events(job["id"])]
    assert any('"model_mismatch"' in each for each in words)
    assert not any('"surprise"' in each or '"cause"' in each for each in words)


def test_the_same_on_a_postgresql_server(store: Store, postgres: Server, tmp_path: Path) -> None:
    """The rows of the file, put into a database of revision 0008 and brought to the present one."""
    url = postgres.database()
    new = Store(tmp_path, url)
    old = create_engine(f"sqlite:///{store.folder / 'old.sqlite'}")
    with new.engine.begin() as to, old.connect() as source:
        migrate(to, "0008")
        metadata = MetaData()
        metadata.reflect(source)
        for name in ("loops", "jobs", "events", "retunes", "retune_loops"):
            rows = [dict(row) for row in source.execute(select(metadata.tables[name])).mappings()]
            to.execute(insert(Table(name, MetaData(), autoload_with=to)), rows)
        migrate(to, "head")
    try:
        for golden in GOLDEN["jobs"].values():
            assert shown(new, golden["id"]) == with_later_fields(golden)
    finally:
        new.close()


def test_the_migration_can_be_taken_back(store: Store) -> None:
    """Down and up again: nothing is lost on the way."""
    before = {job["id"]: store.get(job["id"]).result for job in GOLDEN["jobs"].values()}
    with store.engine.begin() as connection:
        migrate(connection, "0008")
        stored = [each for (each,) in connection.execute(text("SELECT result FROM jobs")) if each is not None]
        assert not any("new_gains" in each or "procedure" in each for each in stored)
        migrate(connection, "head")
    assert {job_id: store.get(job_id).result for job_id in before} == before
