"""The cookie of a browser's session, and what a request that comes with it must show before it changes anything.

Cookies know no ports: a page of another service on this host is of the same site, and SameSite does not keep it out.
The name of the cookie has the port, so that signing in to another service on this host leaves the session of this one.
"""

from __future__ import annotations

import hmac
import re

from starlette.datastructures import Headers
from starlette.requests import cookie_parser

CSRF_HEADER = "X-Loopwright-CSRF"
_NAME = "loopwright_session"


def cookie_name(headers: Headers, scheme: str) -> str:
    """The name of the cookie under the address that the browser has asked.

    The prefix lets a browser take the cookie over TLS only, and from this host only.
    """
    port = re.search(r":([0-9]{1,5})$", headers.get("host", ""))
    name = f"{_NAME}_{port[1]}" if port else _NAME
    return f"__Host-{name}" if scheme == "https" else name


def token_of(headers: Headers, scheme: str) -> str | None:
    """The token of the session in the request's cookies; None: there is none."""
    for line in headers.getlist("cookie"):
        if token := cookie_parser(line).get(cookie_name(headers, scheme)):
            return token
    return None


def from_elsewhere(headers: Headers) -> str | None:
    """Why a request cannot be of a page of this service; None: nothing speaks against it."""
    site, origin, host = headers.get("sec-fetch-site"), headers.get("origin"), headers.get("host", "")
    if site not in (None, "same-origin"):
        return f"a page of another address may not do this (Sec-Fetch-Site: {site[:40]}): use the page at /ui/"
    if origin is not None and origin not in (f"https://{host}", f"http://{host}"):
        return (
            f"a page of {origin[:200]} may not do this at {host[:200]}: use the page at /ui/; "
            "a proxy in between must pass the header Host on"
        )
    return None


def not_proved(headers: Headers, csrf: str) -> str | None:
    """Why a change under a cookie is refused; None: it is not."""
    if why := from_elsewhere(headers):
        return why
    given = headers.get(CSRF_HEADER, "")
    if not given:
        return f"a change with the cookie of a session needs the header {CSRF_HEADER} with csrf of GET /session"
    if not hmac.compare_digest(given.encode(), csrf.encode()):
        return f"{CSRF_HEADER} is not that of this session: GET /session has it; then repeat the request"
    return None
