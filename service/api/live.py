"""The route of the live stream."""

from __future__ import annotations

import re
from typing import Annotated

from fastapi import APIRouter, Header, Query
from fastapi.exceptions import RequestValidationError
from fastapi.responses import StreamingResponse

from loopwright.service.api import problems
from loopwright.service.api.events import still_permitted
from loopwright.service.api.routes import new_router
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.live.live import MOST_BACK_S, Live
from loopwright.service.security.principal import current
from loopwright.service.security.sessions import BrowserSessions
from loopwright.service.store.keyring import Keyring

MOST_LOOPS = 8
_EVENT_ID = re.compile(r"([0-9a-f]{1,32})\.([0-9]{1,9})")


def router(live: Live, directory: LoopDirectory, keyring: Keyring | None, sessions: BrowserSessions) -> APIRouter:
    """A router with GET /live. keyring: None where no keys are asked for."""
    routes = new_router("live")

    @routes.get(
        "/live",
        summary="All loops as they are, once a second, and samples and events of some, as server-sent events",
        response_class=StreamingResponse,
        responses={
            200: {
                "content": {"text/event-stream": {}},
                "description": "Messages: hello, loops, buses, alarms, samples, jobs, job. docs/rest.md has an example "
                "of each",
            },
            **problems.responses(404, 422),
        },
    )
    def stream_live(
        loops: Annotated[
            str,
            Query(
                max_length=1000,
                description=f"Tags of the loops whose samples and job events are wanted, at most {MOST_LOOPS}, with "
                "commas between them; empty: none",
                examples=["TIC-101,TIC-102"],
            ),
        ] = "",
        back_s: Annotated[
            float,
            Query(
                ge=0, le=MOST_BACK_S, allow_inf_nan=False, examples=[130],
                description="How far the first samples go back, s, as far as they are in memory",
            ),
        ] = 10.0,
        last_event_id: Annotated[
            str,
            Header(max_length=64, description="Id of the last event received; browsers send it when they reconnect"),
        ] = "",
    ) -> StreamingResponse:  # fmt: skip
        tags = tuple(dict.fromkeys(tag for part in loops.split(",") if (tag := part.strip())))
        if len(tags) > MOST_LOOPS:
            why = f"must name {MOST_LOOPS} loops at most, not {len(tags)}"
            raise RequestValidationError([{"type": "value_error", "loc": ("query", "loops"), "msg": why}])
        for tag in tags:
            directory.owner(tag)
        known = _EVENT_ID.fullmatch(last_event_id)
        after = {known[1]: int(known[2])} if known else {}
        stream = live.stream(tags, back_s, after, still_permitted(keyring, sessions, current.get()))
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(stream, media_type="text/event-stream", headers=headers)

    return routes
