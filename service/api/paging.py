"""Lists in pages, by `limit` and `cursor` in the query. The Link header of an answer has the URL of the next page, if
there is one (RFC 8288, rel="next")."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlencode

from fastapi import Query, Response

from loopwright.service.api.problems import Responses

LARGEST = 2**53
"""Maximum of an integer in a query or a header: JSON numbers are exact up to it, and every database can store it."""
Limit = Annotated[int, Query(ge=1, le=1000, description="Maximum number of entries")]
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
