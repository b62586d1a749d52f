"""What was delivered to the webhooks, and the webhooks themselves in the OpenAPI document."""

from __future__ import annotations

from typing import Annotated

from fastapi import FastAPI, Header, Response
from pydantic import BaseModel, Field

from loopwright.service.api import problems
from loopwright.service.api.paging import LINK, Cursor, Limit, more
from loopwright.service.api.routes import add, new_router
from loopwright.service.live.webhooks.messages import JobMessage
from loopwright.service.store import webhook_deliveries
from loopwright.service.store.store import Store
from loopwright.service.store.webhook_deliveries import DeliveryState

_TAG = "webhooks"


class WebhookDelivery(BaseModel):
    """A message to a webhook, without its body."""

    id: str = Field(description="The header webhook-id, the same at each attempt", examples=["msg_p5jXN8AQM9LWM0D4"])
    webhook: str = Field(description="Name of the webhook in loops.yaml", examples=["plant-it"])
    job: str = Field(description="URL of the job", examples=["/jobs/4f0c2a9be113"])
    at: str = Field(description="When it came about: UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    state: DeliveryState = Field(
        description="waiting: for its next attempt; delivered; given_up: after the last attempt, or because the "
        "receiver has answered 410, or the webhook is not configured any more",
        examples=["delivered"],
    )
    attempts: int = Field(description="Number of attempts so far", examples=[1])
    error: str | None = Field(description="Why the last attempt failed; null: it did not", examples=["it answered 500"])


def install(app: FastAPI, store: Store) -> None:
    """Adds GET /webhooks/deliveries, and what the service itself calls to the document."""
    router = new_router(_TAG)

    @router.get(
        "/webhooks/deliveries",
        summary="The latest messages to webhooks, the latest first",
        responses={**LINK, **problems.responses(422)},
    )
    def list_webhook_deliveries(response: Response, limit: Limit = 50, cursor: Cursor = None) -> list[WebhookDelivery]:
        found = webhook_deliveries.latest(store, limit + 1, cursor)
        if len(found) > limit:
            more(response, "/webhooks/deliveries", found[limit - 1].number, limit=limit)
        return [
            WebhookDelivery(
                id=each.id, webhook=each.hook, job=f"/jobs/{each.job_id}", at=each.at, state=each.state,
                attempts=each.attempts, error=each.error,
            )
            for each in found[:limit]
        ]  # fmt: skip

    add(app, router)

    @app.webhooks.post(
        "job",
        operation_id="announce_job",
        tags=[_TAG],
        status_code=204,
        summary="A job awaits a decision, or has ended",
    )
    def announce_job(
        message: JobMessage,
        webhook_id: Annotated[
            str,
            Header(
                description="Id of the message: a message may come twice, with the same id", examples=["msg_p5jXN8AQ"]
            ),
        ],
        webhook_timestamp: Annotated[
            int, Header(description="When this attempt was made, s since 1970 UTC", examples=[1769860830])
        ],
        webhook_signature: Annotated[
            str,
            Header(
                description="`v1,` and the base64 of HMAC-SHA256 over ID.TIMESTAMP.BODY with the secret, as Standard "
                "Webhooks has it",
                examples=["v1,K5oZfzN95Z9UVu1EsfQmfVNQhnkZ2pj9o9NDN/H/pI4="],
            ),
        ],
    ) -> None:
        """The service posts this to each webhook of loops.yaml. Any answer of 2xx takes the message; after any other,
        or none within 10 s, it comes again, for a day at longer and longer intervals; 410 ends that at once. Redirects
        are not followed."""
