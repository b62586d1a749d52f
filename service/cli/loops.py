"""`loopwright loop`, `loopwright observe`, `loopwright lock` and `loopwright unlock`."""

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
    """Show a loop and its present state."""
    from loopwright.service.api.job_views import LoopDetail
    from loopwright.service.cli import job_tables

    found = Client(url).get(f"/loops/{quote(tag, safe='')}")
    if as_json:
        print_json(found)
    else:
        job_tables.loop_report(LoopDetail.model_validate(found))


@app.command()
def observe(
    tag: Tag,
    ms: Annotated[float, typer.Option(help="Ms that is designed for: 1.2 robust .. 1.6 .. 2.0 fast.")] = 1.6,
    derivative: Annotated[
        bool, typer.Option("--derivative", help="Design a PID where it is better than a PI.")
    ] = False,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Show what the set-point changes in the history of a loop tell of its gains. Nothing is moved or written on it.

    Exit status 0: gains are proposed; 3: they are not, and why is said.
    """
    from loopwright.service.observing.observed import ObservationState, ObservationView

    path = f"/loops/{quote(tag, safe='')}/observation"
    found = Client(url).get(path, ms=ms, derivative=str(derivative).lower())
    shown = ObservationView.model_validate(found)
    if as_json:
        print_json(found)
    else:
        from loopwright.service.cli import observation_tables
        from loopwright.service.cli.job_tables import console

        observation_tables.show(shown, console)
    if shown.state is not ObservationState.PROPOSAL:
        raise typer.Exit(3)


@app.command()
def lock(
    tag: Tag,
    reason: Annotated[str, typer.Option(help="Reason, shown to everyone whose test is refused.")],
    by: Annotated[
        str | None, typer.Option(help="Name of the person who locks the loop; default: the user logged in.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Lock a loop: until it is unlocked no test begins on it, and no decision writes to it."""
    from loopwright.service.cli.answers import LockAnswer

    answer = Client(url).post(f"/loops/{quote(tag, safe='')}/lock", {"reason": reason, "by": by or user()})
    if as_json:
        print_json(answer)
        return
    found = LockAnswer.model_validate(answer)
    print(f"{tag} is locked by {found.locked.by} since {found.locked.since}: {found.locked.reason}")
    if found.note:
        print(found.note)


@app.command()
def unlock(
    tag: Tag,
    by: Annotated[
        str | None, typer.Option(help="Name of the person who unlocks the loop; default: the user logged in.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: AsJson = False,
) -> None:
    """Unlock a loop."""
    from loopwright.service.cli.answers import UnlockAnswer

    answer = Client(url).post(f"/loops/{quote(tag, safe='')}/unlock", {"by": by or user()})
    if as_json:
        print_json(answer)
        return
    was = UnlockAnswer.model_validate(answer).was_locked
    print(f"{tag} was not locked" if was is None else f"{tag} is unlocked; it was locked by {was.by}: {was.reason}")
