"""Lists in pages, by `limit` and `cursor` in the query. The Link header of an answer has the URL of the next page, if
there is one (RFC 8288, rel="next")."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, TypeVar
from urllib.parse import urlencode

from fastapi import Query, Response
from pydantic import BaseModel

from loopwright.service.api.problems import Responses

LARGEST = 2**53
"""Maximum of an integer in a query or a header: JSON numbers are exact up to it, and every database can store it."""
Limit = Annotated[int, Query(ge=1, le=1000, description="Maximum number of entries")]
JobLimit = Annotated[int, Query(ge=1, le=200, description="Maximum number of jobs, each with its stages and result")]
Cursor = Annotated[
    int | None, Query(ge=1, le=LARGEST, description="Cursor from the URL of the next page, unchanged", examples=[17])
]
LINK: Responses = {
    200: {
        "headers": {
            "Link": {
                "description": 'URL of the next page, `<URL>; rel="next"`; absent on the last page',
                "schema": {"type": "string"},
            }
        }
    }
}
"""The documented Link header of a route with pages."""


def more(response: Response, path: str, cursor: object, **query: object) -> None:
    """Sets the Link header. query: the other parameters of the request; None for one that was not given."""
    given = {name: value for name, value in {**query, "cursor": cursor}.items() if value is not None}
    response.headers["Link"] = f'<{path}?{urlencode(given)}>; rel="next"'


Position = Annotated[
    int | None, Query(ge=1, le=LARGEST, description="Cursor from the URL of the next page, unchanged", examples=[100])
]
"""The cursor of a list that is no longer than what it lists now: how many entries come before the page."""
Entry = TypeVar("Entry")


def page_of(
    response: Response, path: str, entries: Sequence[Entry], limit: int, position: int | None, **query: object
) -> Sequence[Entry]:
    """Returns the page of these entries that begins at a position, and sets the Link header."""
    begin = position or 0
    if len(entries) > begin + limit:
        more(response, path, begin + limit, **query, limit=limit)
    return entries[begin : begin + limit]


def listed(response: Response, views: Iterable[BaseModel]) -> Response:
    """Returns the answer with these entries and the headers of `response`.

    The entries are serialised one by one in the thread of the request. FastAPI would serialise the whole list in the
    event loop, and every other request would wait for a thousand jobs.
    """
    content = b"[" + b",".join(view.model_dump_json().encode() for view in views) + b"]"
    return Response(content, media_type="application/json", headers=dict(response.headers))
