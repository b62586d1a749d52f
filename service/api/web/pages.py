"""Sends the files of the operators' page."""

from __future__ import annotations

import os
from pathlib import Path

import anyio.to_thread
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from loopwright.service.api.web.compressed import TEXTS, compressed, takes_gzip

FILES = Path(__file__).parent / "static"
POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data:",
        "connect-src 'self'",
        "font-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",
        "trusted-types 'none'",
    )
)
"""Content-Security-Policy: nothing from elsewhere, no script and no style in the text of a page, no text that becomes
markup."""
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-cache",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "screen-wake-lock=(self), camera=(), microphone=(), geolocation=()",
}


_LOOPS = f"loops{os.sep}"


class Pages(StaticFiles):
    """The files below a path. A path that is no file is a place within the page, and is answered with the page itself;
    one that looks like a file and is none is 404, unless it names a loop, whose tag may have a dot in it."""

    def __init__(self) -> None:
        super().__init__(directory=FILES)

    async def get_response(self, path: str, scope: Scope) -> Response:
        try:
            answer = await self._file("index.html" if path == "." else path, scope)
        except HTTPException as refused:
            if refused.status_code != 404 or (os.path.splitext(path)[1] and not path.startswith(_LOOPS)):
                raise
            answer = await self._file("index.html", scope)
        answer.headers.update(HEADERS)
        return answer

    async def _file(self, path: str, scope: Scope) -> Response:
        """A file, text compressed where the browser takes that. Its ETag is a weak one, for it stands for the same text
        either way."""
        answer = await super().get_response(path, scope)
        if os.path.splitext(path)[1] not in TEXTS:
            return answer
        answer.headers["Vary"] = "Accept-Encoding"
        answer.headers["ETag"] = f"W/{answer.headers['ETag']}"
        if not isinstance(answer, FileResponse) or not takes_gzip(Headers(scope=scope).get("accept-encoding", "")):
            return answer
        body = await anyio.to_thread.run_sync(compressed, Path(answer.path))
        kept = {name: answer.headers[name] for name in ("content-type", "last-modified", "etag", "vary")}
        return Response(body, headers=kept | {"Content-Encoding": "gzip"})
