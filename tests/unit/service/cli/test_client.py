"""The command line's client: a POST whose connection broke is repeated once, with the key it was sent with; a job is
followed over a restart of the service."""

from __future__ import annotations

import math
import shlex
from functools import partial
from importlib.metadata import version
from types import SimpleNamespace

import httpx
import pytest

from loopwright.service.cli import client as client_module
from loopwright.service.cli.client import ApiError, Client, NotSent, ServiceAway
from loopwright.service.cli.main import app


def through(
    monkeypatch: pytest.MonkeyPatch, *answers: httpx.Response | Exception
) -> tuple[Client, list[httpx.Request]]:
    """A client that gets these answers in turn, and what it has sent."""
    sent: list[httpx.Request] = []
    left = list(answers)

    def answer(request: httpx.Request) -> httpx.Response:
        sent.append(request)
        now = left.pop(0)
        if isinstance(now, Exception):
            raise now
        return now

    monkeypatch.setattr(httpx, "Client", partial(httpx.Client, transport=httpx.MockTransport(answer)))
    client = Client("http://gateway")
    now = [0.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(client_module, "time", SimpleNamespace(sleep=sleep, monotonic=lambda: now[0]))
    return client, sent


def keys(sent: list[httpx.Request]) -> list[str]:
    return [request.headers["idempotency-key"] for request in sent]


def busy() -> httpx.Response:
    return httpx.Response(409, json={"detail": "still being answered"}, headers={"Retry-After": "1"})


@pytest.mark.parametrize(
    "broken",
    [httpx.RemoteProtocolError("server disconnected"), httpx.ReadError("reset"), httpx.WriteError("broken pipe"),
     httpx.ReadTimeout("no answer")],
)  # fmt: skip
def test_a_broken_connection_is_repeated_once_with_the_same_key(
    monkeypatch: pytest.MonkeyPatch, broken: Exception
) -> None:
    client, sent = through(monkeypatch, broken, httpx.Response(202, json={"id": "x"}))
    assert client.post("/loops/TIC-101/retune", {"Ms": 1.4}) == {"id": "x"}
    first, second = keys(sent)
    assert first == second and len(first) == 32 and sent[0].content == sent[1].content
    client, sent = through(monkeypatch, broken, broken)
    with pytest.raises(ApiError, match=r"POST /loops/TIC-101/retune .*\n.*may have been carried out"):
        client.post("/loops/TIC-101/retune")
    assert len(sent) == 2
    client, _ = through(monkeypatch, broken, httpx.ConnectError("refused"))
    with pytest.raises(ApiError, match=r"no service at .*\n.*may have been carried out"):
        client.post("/loops/TIC-101/retune")


@pytest.mark.parametrize(("status", "ends"), [(422, 2), (404, 2), (401, 2), (409, 3), (500, 1)])
def test_the_exit_status_says_who_can_put_it_right(monkeypatch: pytest.MonkeyPatch, status: int, ends: int) -> None:
    client, _ = through(monkeypatch, httpx.Response(status, json={"detail": "why"}))
    with pytest.raises(ApiError, match="why") as refused:
        client.get("/loops/TIC-101")
    assert refused.value.status == ends


def test_every_post_has_a_key_of_its_own_and_a_get_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    client, sent = through(monkeypatch, *(httpx.Response(200, json={}) for _ in range(3)))
    client.post("/a")
    client.post("/a")
    assert len(set(keys(sent))) == 2
    client.get("/a")
    assert "idempotency-key" not in sent[-1].headers


def test_a_service_that_is_not_there_is_said_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    client, sent = through(monkeypatch, httpx.ConnectError("refused"))
    with pytest.raises(ApiError, match="start one with: loopwright serve"):
        client.post("/a")
    assert len(sent) == 1


@pytest.mark.parametrize(
    ("broken", "why"),
    [(httpx.ReadTimeout("timed out"), "has not answered GET /loops within 30 s"),
     (httpx.ReadError("reset"), r"broke the connection at GET /loops \(reset\)")],
)  # fmt: skip
def test_a_service_that_is_there_is_not_said_to_be_missing(
    monkeypatch: pytest.MonkeyPatch, broken: Exception, why: str
) -> None:
    client, _ = through(monkeypatch, broken)
    with pytest.raises(ApiError, match=why) as raised:
        client.get("/loops")
    assert "no service" not in str(raised.value) and "carried out" not in str(raised.value)


def test_what_the_service_computes_is_waited_for_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    client, sent = through(monkeypatch, *(httpx.Response(200, json={}) for _ in range(3)), httpx.ReadTimeout("late"))
    client.get("/loops")
    client.computed("/loops/TIC-101/observation", Ms=1.4, aim=None)
    client.file("/jobs/x/report")
    assert [each.extensions["timeout"]["read"] for each in sent] == [30.0, 300.0, 300.0]
    assert sent[1].extensions["timeout"]["connect"] == 30.0 and sent[1].url.query == b"Ms=1.4"
    with pytest.raises(ApiError, match="has not answered GET /loops/TIC-101/observation within 300 s"):
        client.computed("/loops/TIC-101/observation")


@pytest.mark.parametrize(
    ("broken", "why"),
    [(httpx.ConnectTimeout("timed out"), "no service at http://gateway"),
     (httpx.WriteTimeout("timed out"), "has not answered GET /loops/TIC-101/observation within 30 s")],
)  # fmt: skip
def test_a_service_that_is_not_reached_is_not_waited_for_longer(
    monkeypatch: pytest.MonkeyPatch, broken: Exception, why: str
) -> None:
    client, _ = through(monkeypatch, broken)
    with pytest.raises(ApiError, match=why):
        client.computed("/loops/TIC-101/observation")


def test_what_is_still_being_answered_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    client, sent = through(monkeypatch, httpx.ReadError("reset"), busy(), busy(), httpx.Response(200, json={"id": "x"}))
    assert client.post("/jobs/x/accept") == {"id": "x"}
    assert len(set(keys(sent))) == 1 and len(sent) == 4


def test_a_conflict_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one with Retry-After where no connection broke: it is of somebody else's making."""
    client, sent = through(monkeypatch, busy())
    with pytest.raises(ApiError, match="still being answered"):
        client.post("/a")
    client, sent = through(monkeypatch, httpx.ReadError("reset"), httpx.Response(409, json={"detail": "busy"}))
    with pytest.raises(ApiError, match="busy"):
        client.post("/a")
    assert len(sent) == 2


def test_it_does_not_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    client, sent = through(monkeypatch, httpx.ReadError("reset"), *(busy() for _ in range(50)))
    with pytest.raises(ApiError, match="still being answered"):
        client.post("/a")
    assert len(sent) < 40


@pytest.mark.parametrize(
    "answer",
    [httpx.Response(200, html="<html>"), httpx.Response(200, content=b""), httpx.Response(404, json=["nothing here"])],
    ids=["a page", "nothing", "a list"],
)
def test_another_program_at_the_address_is_named_as_such(
    monkeypatch: pytest.MonkeyPatch, answer: httpx.Response
) -> None:
    for asked in (lambda client: client.get("/loops"), lambda client: client.pages("/loops")):
        client, _ = through(monkeypatch, answer)
        with pytest.raises(ApiError, match=r"http://gateway/loops is no Loopwright service \(HTTP .*--url"):
            asked(client)


@pytest.mark.parametrize(
    ("command", "answer"),
    [("loops", [{"name": "TIC-101"}]), ("jobs", [{"id": 7}]), ("job 0123456789ab", {"id": "0123456789ab"}),
     ("job 0123456789ab --accept", {"id": "0123456789ab"}), ("job 0123456789ab --follow", {"state": "pondering"}),
     ("loop TIC-101", {}), ("observe TIC-101", {}), ("alarms", {"alarms": None}), ("batches", [{}]),
     ("webhooks", [{}]), ("retune TIC-101 --preview", {}), ("retune TIC-101 --yes --wait", {}),
     ("acknowledge TIC-101", {}), ("lock TIC-101 --reason valve", {}), ("unlock TIC-101", {}),
     ("alternatives 0123456789ab", {})],
)  # fmt: skip
def test_a_service_of_another_version_is_named_as_such(
    monkeypatch: pytest.MonkeyPatch, command: str, answer: object
) -> None:
    through(monkeypatch, *(httpx.Response(200, json=answer) for _ in range(3)))
    with pytest.raises(ApiError, match=rf"than loopwright {version('loopwright')} reads, first at .*/docs"):
        app(shlex.split(command), standalone_mode=False)


def test_pages_are_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    client, _ = through(monkeypatch, httpx.Response(200, json={}))
    with pytest.raises(ApiError, match="is no Loopwright service"):
        client.pages("/loops")


@pytest.mark.parametrize(
    ("body", "why"),
    [({"Ms": math.nan, "T95_s": 60.0}, "^Ms: a finite number"), ({"reason": "\udcff"}, "no UTF-8")],
    ids=["no number", "no text"],
)
def test_what_cannot_be_sent_is_not_sent(monkeypatch: pytest.MonkeyPatch, body: dict[str, object], why: str) -> None:
    client, sent = through(monkeypatch)
    with pytest.raises(NotSent, match=why) as raised:
        client.post("/loops/TIC-101/retune", body)
    assert raised.value.status == 2 and not sent


@pytest.mark.parametrize("key", ["ключ", "abc\n"])
def test_a_key_that_cannot_be_one_is_blamed_on_the_key(monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    monkeypatch.setenv("LOOPWRIGHT_KEY", key)
    with pytest.raises(NotSent, match="LOOPWRIGHT_KEY has characters that no key has"):
        Client("http://gateway")


class TestFollowing:
    """The stream of a job resumes over a restart of the service, which takes seconds."""

    @staticmethod
    def stream(*events: tuple[int, str]) -> httpx.Response:
        said = "".join(f'id: {number}\nevent: note\ndata: {{"text": "{text}"}}\n\n' for number, text in events)
        return httpx.Response(200, text=f"retry: 1000\n\n{said}: the service is stopping\n\n")

    @staticmethod
    def job(state: str) -> httpx.Response:
        return httpx.Response(200, json={"id": "x", "state": state})

    def test_over_a_restart(self, monkeypatch: pytest.MonkeyPatch) -> None:
        away = [httpx.ConnectError("refused")] * 10 + [httpx.Response(502, text="<html>"), httpx.ReadTimeout("late")]
        client, sent = through(
            monkeypatch, self.stream((1, "a"), (2, "b")), httpx.ReadError("reset"), *away,
            self.stream((3, "c")), self.job("proposed"),
        )  # fmt: skip
        assert [data for _, data in client.events("/jobs/x")] == [{"text": each} for each in ("a", "b", "c")]
        asked = [request.headers["last-event-id"] for request in sent if request.url.path == "/jobs/x/events"]
        assert asked == ["0"] + ["2"] * 13

    def test_a_stream_that_ends_before_its_job(self, monkeypatch: pytest.MonkeyPatch) -> None:
        client, sent = through(
            monkeypatch, self.stream((1, "a")), self.job("running"), self.stream((2, "b")), self.job("aborted")
        )
        assert len(list(client.events("/jobs/x"))) == 2 and len(sent) == 4

    def test_every_absence_has_a_minute_of_its_own(self, monkeypatch: pytest.MonkeyPatch) -> None:
        once = [*[httpx.ConnectError("refused")] * 25, self.stream((1, "a")), self.job("running")]
        again = [*[httpx.ConnectError("refused")] * 25, self.stream((2, "b")), self.job("proposed")]
        client, _ = through(monkeypatch, *once, *again)
        assert len(list(client.events("/jobs/x"))) == 2

    def test_not_for_ever(self, monkeypatch: pytest.MonkeyPatch) -> None:
        client, sent = through(monkeypatch, self.stream(), *[httpx.ConnectError("refused")] * 100)
        with pytest.raises(ServiceAway, match=r"no service at http://gateway[^\n]*\nIt was tried again for 60 s"):
            list(client.events("/jobs/x"))
        assert len(sent) == 1 + 60 / 2.0 + 1  # the stream, then every 2 s, the first and the last included

    def test_what_is_refused_is_said_at_once(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for ask in (lambda client: list(client.events("/jobs/x")), lambda client: client.awaited("/jobs/x")):
            client, sent = through(monkeypatch, httpx.Response(404, json={"detail": "no such job"}))
            with pytest.raises(ApiError, match="no such job"):
                ask(client)
            assert len(sent) == 1

    def test_an_answer_is_awaited_as_long(self, monkeypatch: pytest.MonkeyPatch) -> None:
        away = [httpx.ReadError("reset"), httpx.Response(503, json={"detail": "away"}), httpx.ConnectError("refused")]
        client, _ = through(monkeypatch, *away, httpx.Response(200, json={"id": "x"}))
        assert client.awaited("/jobs/x") == {"id": "x"}
        client, _ = through(monkeypatch, *[httpx.ConnectError("refused")] * 100)
        with pytest.raises(ServiceAway, match="for 60 s"):
            client.awaited("/jobs/x")
