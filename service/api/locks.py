"""Routes that lock a loop and unlock it."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Body
from pydantic import BaseModel, Field

from loopwright.service.api import problems
from loopwright.service.api.job_views import Decision, LockView, signed_by
from loopwright.service.api.routes import Tag, new_router
from loopwright.service.inputs.validation import ONE_LINE, STRICT
from loopwright.service.jobs.locking import Locking
from loopwright.service.security.principal import signed


class LockWish(BaseModel):
    """The reason for a lock, and the person who locks the loop."""

    model_config = STRICT

    by: str | None = Field(
        default=None, max_length=100, pattern=ONE_LINE,
        description="Who locks the loop; shown to users whose requests are refused. The default is the name of the key",
        examples=["night shift"],
    )  # fmt: skip
    reason: str = Field(
        min_length=1, max_length=200, pattern=ONE_LINE, description="One line of text",
        examples=["valve is being overhauled"],
    )  # fmt: skip


class LockedView(BaseModel):
    """A loop that has just been locked."""

    loop: str = Field(examples=["TIC-101"])
    locked: LockView
    running_job: str | None = Field(
        description="URL of a job whose test is already running and continues; null: there is none",
        examples=["/jobs/4f0c2a9be113"],
    )
    note: str | None = Field(description="The running test in words, and how to abort it")


class UnlockedView(BaseModel):
    """A loop that has just been unlocked."""

    loop: str = Field(examples=["TIC-101"])
    was_locked: LockView | None = Field(description="The lock that was removed; null: the loop was not locked")


def router(locking: Locking) -> APIRouter:
    """A router with POST /loops/{tag}/lock and POST /loops/{tag}/unlock."""
    routes = new_router("loops")

    @routes.post(
        "/loops/{tag}/lock",
        summary="Lock a loop: no test begins on it and no decision writes to it until it is unlocked",
        responses=problems.responses(404, 409, 422),
    )
    def lock_loop(tag: Tag, asked: Annotated[LockWish, Body()]) -> LockedView:
        row, running = locking.lock(tag, asked.reason, signed(asked.by))
        url = note = None
        if running is not None:
            url = f"/jobs/{running.id}"
            command = f"loopwright job {running.id} --abort"
            note = f"a test is running and goes on: abort it with POST {url}/abort ({command})"
        return LockedView(loop=tag, locked=LockView.of(row), running_job=url, note=note)

    @routes.post(
        "/loops/{tag}/unlock",
        summary="Unlock a loop",
        responses=problems.responses(404, 422),
    )
    def unlock_loop(tag: Tag, decision: Annotated[Decision | None, Body()] = None) -> UnlockedView:
        row = locking.unlock(tag, signed_by(decision))
        return UnlockedView(loop=tag, was_locked=None if row is None else LockView.of(row))

    return routes
