"""Results under the names of the API and tagged with their procedure; evidence and reasons in the words of today."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

NEW_NAMES = {
    "gains": "new_gains",
    "baseline": "before",
    "verification": "after",
    "found": "evidence",
    "verified": "verification",
}
_OLD_NAMES = {new: old for old, new in NEW_NAMES.items()}
_REASONS = {"surprise": "model_mismatch"}
_JSON = sa.JSON(none_as_null=True)
_JOBS = sa.table("jobs", sa.column("id"), sa.column("request", _JSON), sa.column("result", _JSON))
_EVENTS = sa.table("events", sa.column("job_id"), sa.column("seq"), sa.column("kind"), sa.column("data", _JSON))
_TOLD = sa.select(_EVENTS).where(_EVENTS.c.kind.in_(("state", "stage_done")))


def upgrade() -> None:
    _rename_reasons(_REASONS)
    connection = op.get_bind()
    for job_id, request, result in connection.execute(sa.select(_JOBS)).all():
        if result is not None:
            _set_result(job_id, _upgraded(result, request.get("method", "five-stage")))
    for job_id, seq, kind, data in connection.execute(_TOLD).all():
        changed = _event(kind, data, "cause", "reason", _REASONS)
        if changed != data:
            _set_data(job_id, seq, changed)


def downgrade() -> None:
    reasons = {new: old for old, new in _REASONS.items()}
    _rename_reasons(reasons)
    connection = op.get_bind()
    for job_id, _, result in connection.execute(sa.select(_JOBS)).all():
        if result is not None:
            _set_result(job_id, _downgraded(result))
    for job_id, seq, kind, data in connection.execute(_TOLD).all():
        changed = _event(kind, data, "reason", "cause", reasons)
        if changed != data:
            _set_data(job_id, seq, changed)


def _rename_reasons(names: dict[str, str]) -> None:
    for table in ("jobs", "retune_loops"):
        column: sa.ColumnClause[str] = sa.column("reason")
        for old, new in names.items():
            op.execute(sa.update(sa.table(table, column)).where(column == old).values(reason=new))


def _set_result(job_id: str, result: dict[str, Any]) -> None:
    op.execute(sa.update(_JOBS).where(_JOBS.c.id == job_id).values(result=result))


def _set_data(job_id: str, seq: int, data: dict[str, Any]) -> None:
    op.execute(sa.update(_EVENTS).where(_EVENTS.c.job_id == job_id, _EVENTS.c.seq == seq).values(data=data))


def _upgraded(result: dict[str, Any], method: str) -> dict[str, Any]:
    method = result.get("method") or method
    new = {NEW_NAMES.get(name, name): value for name, value in result.items()}
    new |= {"method": method, "procedure": "fast" if method == "fast" else "five-stage"}
    for name in ("chosen", "notes"):
        new[name] = new.get(name) or ([] if name == "notes" else {})
    for name in ("old_gains", "new_gains"):
        if new.get(name):
            new[name] = _whole(new[name])
    if new.get("evidence"):
        new["evidence"] = _renamed(new["evidence"], "cause", "reason", _REASONS)
    if new.get("verification"):
        new["verification"] |= new["verification"]["tested"]
    if new.get("rehearsed_on"):
        urls = {name: new["rehearsed_on"][name] for name in ("plant_job", "gains_job")}
        new["rehearsed_on"] |= {name: f"/jobs/{job}" for name, job in urls.items() if job is not None}
    return new


def _downgraded(result: dict[str, Any]) -> dict[str, Any]:
    old = {_OLD_NAMES.get(name, name): value for name, value in result.items() if name != "procedure"}
    if old.get("found"):
        reasons = {new: old for old, new in _REASONS.items()}
        old["found"] = _renamed(old["found"], "reason", "cause", reasons)
    if old.get("verified"):
        tested = {name: old["verified"][name] for name in ("Kp", "Ti", "Td")}
        old["verified"] = old["verified"] | {"tested": old["verified"].get("tested", tested)}
    if old.get("rehearsed_on"):
        on = old["rehearsed_on"]
        old["rehearsed_on"] = on | {
            name: on[name].removeprefix("/jobs/") for name in ("plant_job", "gains_job") if on[name] is not None
        }
    return old


def _whole(gains: dict[str, Any]) -> dict[str, Any]:
    """Rehearsals left out the set-point weights, which were 1 and 0."""
    known = {name: value for name, value in gains.items() if value is not None}
    return {"form": "ISA", "Ti": 0.0, "Td": 0.0, "Tf": 0.0, "b": 1.0, "c": 0.0} | known


def _event(kind: str, data: dict[str, Any], old: str, new: str, reasons: dict[str, str]) -> dict[str, Any]:
    """The data of an event: a reason that the state gives, and the evidence that a stage of fast found."""
    if kind == "state" and data.get("reason") in reasons:
        return data | {"reason": reasons[data["reason"]]}
    result = data.get("result")
    if kind == "stage_done" and isinstance(result, dict) and "ambiguity" in result:
        return data | {"result": _renamed(result, old, new, reasons)}
    return data


def _renamed(evidence: dict[str, Any], old: str, new: str, reasons: dict[str, str]) -> dict[str, Any]:
    """The evidence with its reason under the new name and in the new words."""
    if old not in evidence:
        return evidence
    return {(new if name == old else name): value for name, value in evidence.items()} | {
        new: reasons.get(evidence[old], evidence[old])
    }
