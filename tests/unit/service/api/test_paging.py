"""Lists in pages: where they are serialised."""

from __future__ import annotations

import threading

from fastapi import FastAPI, Response
from fastapi.testclient import TestClient
from pydantic import BaseModel, field_serializer

from loopwright.service.api.paging import listed, more


class Entry(BaseModel):
    n: int

    @field_serializer("n")
    def _noted(self, n: int) -> int:
        serialised_in.add(threading.get_ident())
        return n


serialised_in: set[int] = set()


def test_a_list_is_serialised_outside_the_event_loop() -> None:
    app = FastAPI()
    event_loop = set()

    @app.get("/event-loop")
    async def own_thread() -> None:
        event_loop.add(threading.get_ident())

    @app.get("/entries", response_model=list[Entry])
    def entries(response: Response) -> Response:
        more(response, "/entries", 3)
        return listed(response, [Entry(n=1), Entry(n=2)])

    with TestClient(app) as client:
        client.get("/event-loop")
        answer = client.get("/entries")
    assert answer.json() == [{"n": 1}, {"n": 2}]
    assert answer.headers["Link"] == '</entries?cursor=3>; rel="next"'
    assert answer.headers["Content-Type"] == "application/json"
    assert serialised_in and event_loop and not serialised_in & event_loop
