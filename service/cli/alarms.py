"""`loopwright alarms`."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

import typer

from loopwright.service.cli.client import DEFAULT_URL, Client, parsed
from loopwright.service.cli.output import AsJson, Url, print_json, user

app = typer.Typer()


@app.command()
def alarms(
    acknowledge: Annotated[
        str | None,
        typer.Option("--acknowledge", metavar="ID", help="Acknowledge this alarm: you answer for it, and it ends."),
    ] = None,
    by: Annotated[
        str | None, typer.Option(help="Name of the person who acknowledges it; default: the user logged in.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Show the active alarms, the worst first, or acknowledge one."""
    from loopwright.service.alarms.alarm import Alarm

    client = Client(url)
    if acknowledge is not None:
        answer = client.post(f"/alarms/{quote(acknowledge, safe='')}/acknowledge", {"by": by or user()})
        if as_json:
            print_json(answer)
            return
        alarm = parsed(Alarm, answer)
        if (done := alarm.acknowledged) is not None:
            print(f"{alarm.subject}: acknowledged by {done.by} at {done.at}: {alarm.text}")
        return
    answer = client.get("/alarms")
    if as_json:
        print_json(answer)
        return
    found = parsed(list[Alarm], answer)
    if not found:
        print("No active alarms.")
        return
    from loopwright.service.cli import terminal

    rows = (
        (alarm.priority, alarm.subject, alarm.text, alarm.since, alarm.id if alarm.unacknowledged else "")
        for alarm in found
    )
    terminal.rows("alarms", ("priority", "of", "what", "since", "acknowledge with"), rows)
    for advice in dict.fromkeys(f"{each.subject}: {each.advice}" for each in found):
        terminal.console.print(advice, highlight=False, soft_wrap=True)
