"""Lists in pages: `limit` and `cursor` in the query; where there is more, the answer's Link header has the next page's
URL (RFC 8288, rel="next")."""

from __future__ import annotations

from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import Query, Response

LARGEST = 2**53
"""Of whole numbers in a query or a header: so far JSON's numbers are exact, and every database has room for them."""
Limit = Annotated[int, Query(ge=1, le=1000, description="At most so many")]
Cursor = Annotated[
    int | None, Query(ge=1, le=LARGEST, description="From the URL of the next page, as it came", examples=[17])
]
LINK: dict[int | str, dict[str, Any]] = {
    200: {
        "headers": {
            "Link": {
                "description": 'URL of the next page, `<URL>; rel="next"`; not there on the last one',
                "schema": {"type": "string"},
            }
        }
    }
}
"""For the documented answers of a route that has pages."""


def more(response: Response, path: str, cursor: object, **query: object) -> None:
    """Tells where the next page is. query: what else was asked; None: not asked."""
    kept = {name: value for name, value in {**query, "cursor": cursor}.items() if value is not None}
    response.headers["Link"] = f'<{path}?{urlencode(kept)}>; rel="next"'
