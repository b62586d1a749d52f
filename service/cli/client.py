"""The HTTP client of the commands. httpx is imported where it is used, because most commands do not need it."""

from __future__ import annotations

import json
import math
import os
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import httpx

    from loopwright.service.cli.plots.shown import ShownSamples

T = TypeVar("T")

DEFAULT_URL = "http://127.0.0.1:8080"
KEY_VARIABLE = "LOOPWRIGHT_KEY"
"""The key is in the environment, because every user of the machine can read a command line."""
_PATIENCE_S = 30.0
"""Longest wait for an answer, also to a request that is repeated because its connection broke, wall time, s."""
_COMPUTED_PATIENCE_S = 300.0
"""Longest wait for an answer that the service computes when it is asked for, wall time, s. It takes seconds, and longer
where the processors are slow or tests have them first."""
_SILENT_S = 15.0
"""Wall time after which a live stream that says nothing counts as cut off, s; it speaks about once a second."""
_SILENT_EVENTS_S = 60.0
"""Wall time after which the stream of a job that says nothing counts as cut off, s; it speaks every 15 s."""
_AGAIN_S = 2.0
"""Wall time between two attempts to reach a service that is followed, s."""
_ABSENT_S = 60.0
"""Wall time for which a service that is followed may be away, s: it starts again within it."""
_AWAY = (502, 503, 504)
"""Status of an answer, of the service or of a proxy before it, after which the same request may soon succeed."""

_PERHAPS_CARRIED_OUT = "What was asked may have been carried out: look at the loop and its jobs before you repeat it."


class ApiError(Exception):
    """The service refused the request or does not answer; the text says which, and what to do.

    status: the exit status of the command.
    """

    status = 1


class NotSent(ApiError):
    """What was to be sent can be no request."""

    status = 2


class Wrong(ApiError):
    """The service refuses what was given: a value, a name, or the key."""

    status = 2


class NotNow(ApiError):
    """What was given is good, and the loop or the job does not permit it as it is."""

    status = 3


_REFUSALS: dict[int, type[ApiError]] = {
    400: Wrong, 401: Wrong, 403: Wrong, 404: Wrong, 413: Wrong, 415: Wrong, 422: Wrong, 409: NotNow,
}  # fmt: skip


class ServiceAway(ApiError):
    """The service does not answer, or says that it cannot do so now."""


class _Absence:
    """For how long the service has been away."""

    def __init__(self) -> None:
        self._since: float | None = None

    def over(self) -> None:
        self._since = None

    def wait(self, error: ServiceAway) -> None:
        """Waits until the next attempt; raises ServiceAway after a minute without the service."""
        now = time.monotonic()
        if self._since is None:
            self._since = now
        if now - self._since >= _ABSENT_S:
            raise ServiceAway(f"{error}\nIt was tried again for {_ABSENT_S:g} s.") from error
        time.sleep(_AGAIN_S)


class Client:
    """A client of one service. Every request raises ApiError if the service refuses it or does not answer."""

    def __init__(self, url: str) -> None:
        import httpx

        if not url.startswith(("http://", "https://")):
            raise NotSent(f"--url takes the address of a service as http://HOST:PORT, or https, not {url!r}")
        self.url = url.rstrip("/")
        key = os.environ.get(KEY_VARIABLE, "")
        if not (key.isascii() and key.isprintable()):
            raise NotSent(f"{KEY_VARIABLE} has characters that no key has, or an end of a line: copy the key again")
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._http = httpx.Client(base_url=self.url, timeout=_PATIENCE_S, trust_env=False, headers=headers)

    def get(self, path: str, **query: str | float | None) -> object:
        """Returns the JSON of the answer; a query of None is left out."""
        return _json(self._answer("GET", path, _given(query)))

    def computed(self, path: str, **query: str | float | None) -> object:
        """As `get`, for an answer that the service computes when it is asked for, which is waited for longer."""
        return _json(self._answer("GET", path, _given(query), _COMPUTED_PATIENCE_S))

    def file(self, path: str) -> tuple[str, str]:
        """Returns the file name that the service gives to a text, and the text, which it may have to compute."""
        answer = self._answer("GET", path, patience_s=_COMPUTED_PATIENCE_S)
        _, _, name = answer.headers.get("Content-Disposition", "").partition('filename="')
        return name.partition('"')[0].rpartition("/")[2] or "answer", answer.text

    def samples_of(self, job_url: str) -> Callable[[str | None], ShownSamples]:
        """Returns a function that gets the samples of a job, those of one stage or (None) all."""
        from loopwright.service.cli.plots.shown import ShownSamples

        return lambda stage: parsed(ShownSamples, self.get(f"{job_url}/samples", stage=stage))

    def pages(self, path: str) -> list[object]:
        """Returns all items of a list that the service returns in pages."""
        import httpx

        found: list[object] = []
        following = httpx.URL(path)
        while True:
            answer = self._answer("GET", following)
            page = _json(answer)
            if not isinstance(page, list):
                raise _no_service(answer)
            found += page
            if "next" not in answer.links:
                return found
            following = httpx.URL(answer.links["next"]["url"])

    def post(self, path: str, body: Mapping[str, object] | None = None) -> object:
        """Returns the JSON of the answer.

        When the connection breaks, the request is repeated once with the same Idempotency-Key, by which the service
        recognises it.
        """
        import httpx

        sent, headers = body or {}, {"Idempotency-Key": secrets.token_hex(16)}
        try:
            json.dumps(sent, ensure_ascii=False, allow_nan=False).encode()
        except UnicodeEncodeError:
            raise NotSent("a text has bytes that are no UTF-8") from None
        except ValueError:
            wrong = (name for name, value in sent.items() if isinstance(value, float) and not math.isfinite(value))
            raise NotSent(f"{', '.join(wrong)}: a finite number is expected") from None
        try:
            answer = self._http.post(path, json=sent, headers=headers)
        except httpx.ConnectError as error:
            raise self._no_answer(error, f"POST {path}") from error
        except httpx.TransportError:
            answer = self._repeated(path, sent, headers)
        self._check(answer)
        return _json(answer)

    def _repeated(self, path: str, body: Mapping[str, object], headers: Mapping[str, str]) -> httpx.Response:
        """Repeats a POST; 409 with Retry-After says that the service is still busy with the first request."""
        give_up = time.monotonic() + _PATIENCE_S
        while True:
            answer = self._send("POST", path, body=body, headers=headers)
            wait = answer.headers.get("Retry-After", "")
            if answer.status_code != 409 or not wait.isdigit() or time.monotonic() + int(wait) > give_up:
                return answer
            time.sleep(int(wait))

    def awaited(self, path: str) -> object:
        """As `get`, of a service that may be starting again: for a minute it is asked again."""
        absence = _Absence()
        while True:
            try:
                return self._there(path)
            except ServiceAway as error:
                absence.wait(error)

    def events(self, job_url: str) -> Iterator[tuple[str, object]]:
        """Yields the kind and the JSON of each event of a job until the job is over.

        The stream resumes when the connection breaks, and when the service has ended it before the job is over, as a
        service that stops does. Raises ServiceAway when it does not resume within a minute.
        """
        import httpx

        from loopwright.service.cli.answers import JobAnswer
        from loopwright.service.states.job_state import ACTIVE

        last, absence = "0", _Absence()
        while True:
            try:
                headers = {"Last-Event-ID": last}
                timeout = httpx.Timeout(10.0, read=_SILENT_EVENTS_S)
                with self._http.stream("GET", f"{job_url}/events", headers=headers, timeout=timeout) as answer:
                    self._check_there(answer)
                    absence.over()
                    for fields in _events_of(answer):
                        last = fields.get("id", last)
                        yield fields["event"], json.loads(fields["data"])
                if parsed(JobAnswer, self._there(job_url)).state not in ACTIVE:
                    return
                time.sleep(_AGAIN_S)
            except httpx.TransportError as error:
                absence.wait(self._no_answer(error, f"GET {job_url}/events", patience_s=_SILENT_EVENTS_S))
            except ServiceAway as error:
                absence.wait(error)

    def live(self, tag: str) -> Iterator[tuple[str, object]]:
        """Yields the name and the JSON of each message of the live stream about a loop, for ever. While the service is
        not reached, `lost` comes, with why, at each attempt to reach it."""
        import httpx

        while True:
            try:
                timeout = httpx.Timeout(10.0, read=_SILENT_S)
                with self._http.stream("GET", "/live", params={"loops": tag, "back_s": "0"}, timeout=timeout) as answer:
                    self._check(answer)
                    for fields in _events_of(answer):
                        yield fields["event"], json.loads(fields["data"])
            except httpx.TransportError as error:
                yield "lost", f"the service at {self.url} is not reached ({error}), it is tried again"
            else:
                yield "lost", f"the service at {self.url} has ended the stream, it is tried again"
            time.sleep(_AGAIN_S)

    def _answer(
        self,
        method: str,
        path: str | httpx.URL,
        query: Mapping[str, str | float] | None = None,
        patience_s: float = _PATIENCE_S,
    ) -> httpx.Response:
        answer = self._send(method, path, query, patience_s=patience_s)
        self._check(answer)
        return answer

    def _send(
        self,
        method: str,
        path: str | httpx.URL,
        query: Mapping[str, str | float] | None = None,
        body: Mapping[str, object] | None = None,
        headers: Mapping[str, str] | None = None,
        patience_s: float = _PATIENCE_S,
    ) -> httpx.Response:
        import httpx

        try:
            usual = patience_s == _PATIENCE_S
            timeout = httpx.USE_CLIENT_DEFAULT if usual else httpx.Timeout(_PATIENCE_S, read=patience_s)
            return self._http.request(method, path, params=query, json=body, headers=headers, timeout=timeout)
        except httpx.TransportError as error:
            carried_out = "" if method == "GET" else "\n" + _PERHAPS_CARRIED_OUT
            raise self._no_answer(error, f"{method} {path}", carried_out, patience_s) from error

    def _no_answer(
        self, error: httpx.TransportError, asked: str, carried_out: str = "", patience_s: float = _PATIENCE_S
    ) -> ServiceAway:
        import httpx

        if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
            why = f"no service at {self.url} ({error}); start one with: loopwright serve"
        elif isinstance(error, httpx.TimeoutException):
            within_s = patience_s if isinstance(error, httpx.ReadTimeout) else _PATIENCE_S
            why = f"the service at {self.url} has not answered {asked} within {within_s:g} s; its log says why"
        else:
            why = f"the service at {self.url} broke the connection at {asked} ({error}); its log says why"
        return ServiceAway(why + carried_out)

    def _there(self, path: str) -> object:
        answer = self._send("GET", path)
        self._check_there(answer)
        return _json(answer)

    def _check_there(self, answer: httpx.Response) -> None:
        """Raises ServiceAway where the service cannot answer now, ApiError where it refuses."""
        try:
            self._check(answer)
        except ApiError as error:
            if answer.status_code in _AWAY:
                raise ServiceAway(str(error)) from error
            raise

    @staticmethod
    def _check(answer: httpx.Response) -> None:
        if answer.is_success:
            return
        answer.read()
        try:
            body = answer.json()
        except ValueError:
            raise ApiError(f"HTTP {answer.status_code}: {answer.text[:200]}") from None
        if not isinstance(body, dict):
            raise _no_service(answer)
        if answer.status_code == 401:
            body["advice"] = f"Put an API key into the environment variable {KEY_VARIABLE}."
        lines = [body.get("detail") or body.get("title"), body.get("advice"), body.get("job")]
        refused = _REFUSALS.get(answer.status_code, ApiError)
        raise refused("\n".join(line for line in lines if line))


def _given(query: Mapping[str, str | float | None]) -> dict[str, str | float]:
    return {name: value for name, value in query.items() if value is not None}


def _events_of(answer: httpx.Response) -> Iterator[dict[str, str]]:
    """Yields the fields of each server-sent event that has a name; others are for browsers."""
    fields: dict[str, str] = {}
    for line in answer.iter_lines():
        name, _, value = line.partition(": ")
        if line:
            fields[name] = value
        else:
            if "event" in fields:
                yield fields
            fields = {}


def _json(answer: httpx.Response) -> object:
    try:
        found: object = answer.json()
    except ValueError:
        raise _no_service(answer) from None
    return found


def parsed(form: type[T], answer: object) -> T:
    """Returns an answer of the service, or a part of one, in its form; raises ApiError where it has another one."""
    from importlib.metadata import version

    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(form).validate_python(answer)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise ApiError(
            f"the service has done what was asked, but answers in another form than loopwright {version('loopwright')} "
            f"reads, first at {where} ({first['msg']}): it is of another version, which its page /docs names; use the "
            "commands of that version"
        ) from error


def _no_service(answer: httpx.Response) -> ApiError:
    """The error of an answer that no Loopwright service gives."""
    said = f"HTTP {answer.status_code}, {answer.headers.get('Content-Type', 'without a type')}"
    return ApiError(f"what answers at {answer.url} is no Loopwright service ({said}); give its address with --url")
