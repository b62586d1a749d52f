"""`loopwright loop`, `lock` and `unlock`."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

import typer

from loopwright.service.cli.client import DEFAULT_URL, Client
from loopwright.service.cli.output import AsJson, Url, print_json, user

app = typer.Typer()

Tag = Annotated[str, typer.Argument(help="Tag of the loop.")]


@app.command("loop")
def one_loop(tag: Tag, url: Url = DEFAULT_URL, as_json: AsJson = False) -> None:
    """A loop and its present state."""
    from loopwright.service.api.job_views import LoopDetail
    from loopwright.service.cli import job_tables

    found = Client(url).get(f"/loops/{quote(tag, safe='')}")
    if as_json:
        print_json(found)
    else:
        job_tables.loop_report(LoopDetail.model_validate(found))


@app.command()
def lock(
    tag: Tag,
    reason: Annotated[str, typer.Option(help="Why; whoever is refused is shown it.")],
    by: Annotated[str | None, typer.Option(help="Who locks it, for the others; default: who is logged in.")] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Lock a loop: no test begins on it and no decision writes to it until it is unlocked."""
    found = Client(url).post(f"/loops/{quote(tag, safe='')}/lock", {"reason": reason, "by": by or user()})
    if as_json:
        print_json(found)
        return
    locked = found["locked"]
    print(f"{tag} is locked by {locked['by']} since {locked['since']}: {locked['reason']}")
    if found["note"]:
        print(found["note"])


@app.command()
def unlock(
    tag: Tag,
    by: Annotated[str | None, typer.Option(help="Who unlocks it; default: who is logged in.")] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Unlock a loop."""
    found = Client(url).post(f"/loops/{quote(tag, safe='')}/unlock", {"by": by or user()})
    if as_json:
        print_json(found)
    elif found["was_locked"] is None:
        print(f"{tag} was not locked")
    else:
        print(f"{tag} is not locked any more; it was by {found['was_locked']['by']}: {found['was_locked']['reason']}")
