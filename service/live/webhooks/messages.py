"""What a webhook is sent: the body, and the headers of Standard Webhooks (https://www.standardwebhooks.com)."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib.metadata import version

from pydantic import BaseModel, Field
from standardwebhooks import Webhook

from loopwright.service.inputs.webhooks import WebhookEvent
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store.clock import now
from loopwright.service.store.jobs import Job
from loopwright.tuning.reasons import Reason


class AnnouncedJob(BaseModel):
    """The job that awaits a decision or has ended, in brief."""

    id: str = Field(examples=["4f0c2a9be113"])
    url: str = Field(
        description="Where the job is: whole where the service knows its own URL (--own-url), else a path",
        examples=["https://gw-1.example.com/jobs/4f0c2a9be113"],
    )
    page: str = Field(description="The page of its loop", examples=["https://gw-1.example.com/ui/loops/TIC-101"])
    loop: str = Field(examples=["TIC-101"])
    state: JobState = Field(examples=["proposed"])
    reason: Reason | None = Field(description="Why there is no proposal; null: there is or was one")
    detail: str | None = Field(description="The numbers behind the reason")
    dry_run: bool
    by: str = Field(examples=["night shift"])
    gateway: str = Field(description="Name of the gateway that has the loop", examples=["local"])


class JobMessage(BaseModel):
    """The body of a webhook."""

    type: WebhookEvent = Field(
        description="job.needs_decision: a proposal waits to be accepted or rolled back; job.ended: any other end, and "
        "a decision",
        examples=["job.needs_decision"],
    )
    timestamp: str = Field(
        description="When it happened: UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"]
    )
    data: AnnouncedJob


def event_of_move(job: Job) -> WebhookEvent | None:
    """Returns what the present state of a job that has just moved is announced as; None: not at all."""
    if job.state in ACTIVE:
        return None
    return WebhookEvent.NEEDS_DECISION if job.state is JobState.PROPOSED else WebhookEvent.ENDED


def message_of(job: Job, event: WebhookEvent, own_url: str | None) -> JobMessage:
    """Returns the message about a job that has just moved. own_url: where browsers reach this service, if known."""
    base = own_url or ""
    return JobMessage(
        type=event,
        timestamp=now(),
        data=AnnouncedJob(
            id=job.id, url=f"{base}/jobs/{job.id}", page=f"{base}/ui/loops/{job.loop}", loop=job.loop, state=job.state,
            reason=job.reason, detail=job.detail, dry_run=job.dry_run, by=job.by, gateway=job.host,
        ),
    )  # fmt: skip


def headers(message_id: str, at_s: float, body: str, secret: bytes) -> dict[str, str]:
    """Returns the headers of one attempt. at_s: when it is made, s since 1970 UTC."""
    at = datetime.fromtimestamp(int(at_s), UTC)
    return {
        "Content-Type": "application/json",
        "User-Agent": f"loopwright/{version('loopwright')}",
        "Connection": "close",
        "webhook-id": message_id,
        "webhook-timestamp": str(int(at_s)),
        "webhook-signature": Webhook(secret).sign(message_id, at, body),
    }
