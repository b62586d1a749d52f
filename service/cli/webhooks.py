"""`loopwright webhooks`."""

from __future__ import annotations

import typer

from loopwright.service.cli.client import DEFAULT_URL, Client, parsed
from loopwright.service.cli.output import AsJson, Url, print_json

app = typer.Typer()


@app.command()
def webhooks(url: Url = DEFAULT_URL, as_json: AsJson = False) -> None:
    """List the latest messages to webhooks, and what became of each."""
    from datetime import UTC, datetime

    from loopwright.service.api.webhooks import WebhookDelivery
    from loopwright.service.cli import terminal

    found = Client(url).get("/webhooks/deliveries")
    if as_json:
        print_json(found)
        return
    messages, now = parsed(list[WebhookDelivery], found), datetime.now(UTC)
    if not messages:
        print("No message has come about for a webhook.")
        return
    terminal.rows(
        "messages to webhooks",
        ("webhook", "job", "state", "attempts", "last error", "came about"),
        (
            (each.webhook, each.job.removeprefix("/jobs/"), each.state, each.attempts, each.error,
             terminal.ago(each.at, now))
            for each in messages
        ),
        never_cut=("job", "came about"),
    )  # fmt: skip
