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
    sign_off: Annotated[
        str | None,
        typer.Option("--sign-off", metavar="ID", help="Sign this alarm off: you answer for it, and it ends."),
    ] = None,
    by: Annotated[
        str | None, typer.Option(help="Name of the person who signs it off; default: the user logged in.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Show what is abnormal, the worst first, or sign an alarm off."""
    from loopwright.service.alarms.alarm import Alarm

    client = Client(url)
    if sign_off is not None:
        answer = client.post(f"/alarms/{quote(sign_off, safe='')}/sign-off", {"by": by or user()})
        if as_json:
            print_json(answer)
            return
        signed = parsed(Alarm, answer)
        if signed.signed_off is not None:
            print(f"{signed.subject}: signed off by {signed.signed_off.by} at {signed.signed_off.at}: {signed.text}")
        return
    answer = client.get("/alarms")
    if as_json:
        print_json(answer)
        return
    found = parsed(list[Alarm], answer)
    if not found:
        print("Nothing is abnormal.")
        return
    from loopwright.service.cli import terminal

    rows = ((each.level, each.subject, each.text, each.since, each.id if each.to_sign else "") for each in found)
    terminal.rows("alarms", ("level", "of", "what", "since", "sign off with"), rows)
    for advice in dict.fromkeys(f"{each.subject}: {each.advice}" for each in found):
        terminal.console.print(advice, highlight=False, soft_wrap=True)
