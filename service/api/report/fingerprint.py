"""The SHA-256 of a job's result and record, which stays the same whatever is decided later."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable

from loopwright.service.api.job_views import JobView
from loopwright.service.api.samples import csv_text
from loopwright.service.store.sample_blocks import Block

FIELDS = (
    "by", "comparison", "created_at", "design", "detail", "dry_run", "ended_at", "evidence", "gateway", "id",
    "loop", "method", "model", "model_from", "new_gains", "notes", "plant_time_s", "predicted",
    "predicted_previous", "previous_gains", "reason", "rehearsed_on", "request", "sample_time_s", "started_at",
    "step_after", "step_before", "ultimate", "verification",
)  # fmt: skip
"""The fields of GET /jobs/{id} that do not change any more once the job is over."""


def fingerprint(job: JobView, blocks: Iterable[Block]) -> str:
    """Returns the SHA-256, hexadecimal, over these fields of the job as JSON (keys sorted, no spaces, ASCII), followed
    by the bytes of GET /jobs/{id}/samples?format=csv."""
    shown = json.loads(job.model_dump_json(include=set(FIELDS)))
    found = hashlib.sha256(json.dumps(shown, sort_keys=True, separators=(",", ":")).encode())
    for part in csv_text(blocks):
        found.update(part.encode())
    return found.hexdigest()
