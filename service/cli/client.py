"""The service's HTTP API as the command line uses it. httpx is imported where it is used: most commands need none."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import httpx

DEFAULT_URL = "http://127.0.0.1:8080"
KEY_VARIABLE = "LOOPWRIGHT_KEY"
"""In the environment and not on the command line, where every user of the machine could read it."""
_PATIENCE_S = 30.0
"""For the answer to a request whose connection broke while it was being answered."""


class ApiError(Exception):
    """The service said no, or is not there; the text says which and what to do."""


class Client:
    """One service."""

    def __init__(self, url: str) -> None:
        import httpx

        self.url = url.rstrip("/")
        key = os.environ.get(KEY_VARIABLE)
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._http = httpx.Client(base_url=self.url, timeout=30.0, trust_env=False, headers=headers)

    def get(self, path: str, **query: Any) -> Any:
        return self._json("GET", path, params={k: v for k, v in query.items() if v is not None})

    def samples_of(self, job_url: str) -> Callable[[str | None], dict[str, Any]]:
        """Asks for the columns of the samples of a job, of one stage or (None) of all."""
        return lambda stage: self.get(f"{job_url}/samples", stage=stage)

    def pages(self, path: str) -> list[Any]:
        """The whole of a list that comes in pages."""
        import httpx

        found, following = [], httpx.URL(path)
        while True:
            answer = self._answer("GET", following)
            found += answer.json()
            if "next" not in answer.links:
                return found
            following = httpx.URL(answer.links["next"]["url"])

    def post(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """When the connection breaks the request is repeated once, with the key by which the service knows it again."""
        import httpx

        request: dict[str, Any] = {"json": body or {}, "headers": {"Idempotency-Key": secrets.token_hex(16)}}
        try:
            answer = self._http.post(path, **request)
        except httpx.ConnectError as error:
            raise self._no_service(error) from error
        except httpx.TransportError:
            answer = self._repeated(path, request)
        self._check(answer)
        return answer.json()

    def _repeated(self, path: str, request: dict[str, Any]) -> httpx.Response:
        """409 with Retry-After: the service is still busy with what was sent first."""
        give_up = time.monotonic() + _PATIENCE_S
        while True:
            answer = self._send("POST", path, **request)
            wait = answer.headers.get("Retry-After", "")
            if answer.status_code != 409 or not wait.isdigit() or time.monotonic() + int(wait) > give_up:
                return answer
            time.sleep(int(wait))

    def events(self, job_url: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """(kind, data) of each event of a job until it is over; resumes when the connection breaks."""
        import httpx

        last, failures = "0", 0
        while True:
            try:
                headers = {"Last-Event-ID": last}
                timeout = httpx.Timeout(10.0, read=60.0)
                with self._http.stream("GET", f"{job_url}/events", headers=headers, timeout=timeout) as answer:
                    self._check(answer)
                    fields: dict[str, str] = {}
                    for line in answer.iter_lines():
                        name, _, value = line.partition(": ")
                        if line:
                            fields[name] = value
                        elif "event" in fields:
                            last = fields.get("id", last)
                            failures = 0
                            yield fields["event"], json.loads(fields["data"])
                            fields = {}
                return
            except httpx.TransportError as error:
                failures += 1
                if failures > 3:
                    raise ApiError(f"{self.url}: {error}") from error

    def _json(self, method: str, path: str, **more: Any) -> Any:
        return self._answer(method, path, **more).json()

    def _answer(self, method: str, path: str | httpx.URL, **more: Any) -> httpx.Response:
        answer = self._send(method, path, **more)
        self._check(answer)
        return answer

    def _send(self, method: str, path: str | httpx.URL, **more: Any) -> httpx.Response:
        import httpx

        try:
            return self._http.request(method, path, **more)
        except httpx.TransportError as error:
            raise self._no_service(error) from error

    def _no_service(self, error: Exception) -> ApiError:
        return ApiError(f"no service at {self.url} ({error}); start one with: loopwright serve")

    @staticmethod
    def _check(answer: httpx.Response) -> None:
        if answer.is_success:
            return
        answer.read()
        try:
            body = answer.json()
        except ValueError:
            raise ApiError(f"HTTP {answer.status_code}: {answer.text[:200]}") from None
        if answer.status_code == 401:
            body["advice"] = f"Put an API key into the environment variable {KEY_VARIABLE}."
        lines = [body.get("detail") or body.get("title"), body.get("advice"), body.get("job")]
        raise ApiError("\n".join(line for line in lines if line))
