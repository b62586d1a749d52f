"""Webhooks against receivers that really listen: signed, tried again, never sent on by a redirect."""

from __future__ import annotations

import base64
import hashlib
import hmac
import http.server
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from loopwright.service.inputs.config import ConfigError, parse_site
from loopwright.service.inputs.request import retune_request
from loopwright.service.inputs.webhooks import BadSecret, WebhookConfig, read_secret
from loopwright.service.live.webhooks import connection
from loopwright.service.live.webhooks.connection import NotDelivered, post
from loopwright.service.live.webhooks.sender import Sender
from loopwright.service.live.webhooks.times import DeliveryTimes
from loopwright.service.live.webhooks.webhooks import Webhooks
from loopwright.service.states.job_state import JobState
from loopwright.service.store import webhook_deliveries
from loopwright.service.store.store import Store
from loopwright.service.store.webhook_deliveries import DeliveryState
from loopwright.service.telemetry.metrics import WEBHOOK_ATTEMPTS
from tests.unit.service.fakes import TAG, Service, loop_entry
from tests.unit.service.processes import until

SECRET = bytes(range(32))
SOON = DeliveryTimes(delays_s=(0.01,) * 3, look_s=0.01)


class Receiver:
    """A receiver on this machine. answers: the status of each answer in turn; the last one goes on. location: where it
    sends its callers on to."""

    def __init__(self, *answers: int, location: str = "") -> None:
        self.received: list[tuple[dict[str, str], bytes]] = []
        receiver = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.received.append(({name.lower(): value for name, value in self.headers.items()}, body))
                self.send_response(answers[min(len(receiver.received), len(answers)) - 1])
                if location:
                    self.send_header("Location", location)
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}/hook?token=of-the-path"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@pytest.fixture
def receiver() -> Iterator[Callable[..., Receiver]]:
    made: list[Receiver] = []

    def make(*answers: int, location: str = "") -> Receiver:
        made.append(Receiver(*answers, location=location))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def hanging() -> Iterator[str]:
    """The address of a receiver that takes connections and never says anything."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}/hook"


def config(url: str, **changes: Any) -> WebhookConfig:
    entry = {"name": "plant-it", "url": url, "secret_file": "secret", "allow_http": True}
    return WebhookConfig.model_validate(entry | changes)


@contextmanager
def webhooks(
    service: Service, folder: Path, *configs: WebhookConfig, clock: DeliveryTimes = SOON
) -> Iterator[Webhooks]:
    (folder / "secret").write_text("whsec_" + base64.b64encode(SECRET).decode())
    with closing(Webhooks(configs, folder, service.store, "https://gw-1.example.com", clock)) as made:
        made.start()
        yield made


def states(store: Store) -> list[tuple[str, str, int]]:
    return [(each.hook, each.state.value, each.attempts) for each in webhook_deliveries.latest(store, 20)][::-1]


def ended(service: Service, **request: Any) -> str:
    job = service.jobs.start(TAG, retune_request(**request))
    service.wait(job.id)
    return job.id


def test_a_proposal_and_its_acceptance_are_delivered_and_signed(
    service: Service, tmp_path: Path, receiver: Callable[..., Receiver]
) -> None:
    hook = receiver(204)
    with webhooks(service, tmp_path, config(hook.url)):
        job_id = ended(service)
        until(lambda: len(hook.received) == 1)
        service.jobs.decisions.accept(job_id, "A. Lind")
        until(lambda: len(hook.received) == 2)
        until(lambda: states(service.store) == [("plant-it", "delivered", 1)] * 2)
    (first, one), (second, other) = hook.received
    message = json.loads(one)
    assert message["type"] == "job.needs_decision" and message["data"] == {
        "id": job_id, "url": f"https://gw-1.example.com/jobs/{job_id}",
        "page": f"https://gw-1.example.com/ui/loops/{TAG}", "loop": TAG, "state": "proposed", "reason": None,
        "detail": None, "dry_run": False, "by": message["data"]["by"], "gateway": "local",
    }  # fmt: skip
    assert json.loads(other)["type"] == "job.ended" and json.loads(other)["data"]["state"] == "accepted"
    assert first["webhook-id"] != second["webhook-id"] and first["webhook-id"].startswith("msg_")
    for headers, body in hook.received:
        assert abs(int(headers["webhook-timestamp"]) - time.time()) < 60
        assert headers["webhook-signature"] == signature(headers["webhook-id"], headers["webhook-timestamp"], body)
        assert headers["content-type"] == "application/json"


def signature(message_id: str, at: str, body: bytes) -> str:
    """As the specification of Standard Webhooks has it, without the library that signs."""
    signed = hmac.new(SECRET, f"{message_id}.{at}.".encode() + body, hashlib.sha256).digest()
    return f"v1,{base64.b64encode(signed).decode()}"


def test_a_failure_is_tried_again_with_the_same_id(
    service: Service, tmp_path: Path, receiver: Callable[..., Receiver], caplog: pytest.LogCaptureFixture
) -> None:
    hook = receiver(500, 200)
    with webhooks(service, tmp_path, config(hook.url)):
        ended(service)
        until(lambda: states(service.store) == [("plant-it", "delivered", 2)])
    (first, one), (second, other) = hook.received
    assert first["webhook-id"] == second["webhook-id"] and one == other
    assert "it answered 500" in caplog.text and "of-the-path" not in caplog.text
    assert base64.b64encode(SECRET).decode() not in caplog.text


def test_a_message_that_nobody_takes_is_given_up(
    service: Service, tmp_path: Path, receiver: Callable[..., Receiver], caplog: pytest.LogCaptureFixture
) -> None:
    hook = receiver(500)
    before = WEBHOOK_ATTEMPTS.labels("plant-it", "given_up")._value.get()  # noqa: SLF001
    with webhooks(service, tmp_path, config(hook.url)):
        ended(service)
        until(lambda: states(service.store) == [("plant-it", "given_up", 4)])
    assert len(hook.received) == 4
    (given_up,) = [each for each in caplog.records if each.levelno == logging.ERROR]
    assert "is given up after 4 attempts: it answered 500" in given_up.getMessage()
    assert WEBHOOK_ATTEMPTS.labels("plant-it", "given_up")._value.get() == before + 1  # noqa: SLF001


def test_a_receiver_that_wants_nothing_more_is_not_asked_again(
    service: Service, tmp_path: Path, receiver: Callable[..., Receiver]
) -> None:
    hook = receiver(410)
    with webhooks(service, tmp_path, config(hook.url)):
        ended(service)
        until(lambda: states(service.store) == [("plant-it", "given_up", 1)])


def test_a_webhook_that_hangs_delays_nothing(
    service: Service, tmp_path: Path, receiver: Callable[..., Receiver], hanging: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection.post, "__defaults__", (600.0,))
    hook = receiver(200)
    with webhooks(service, tmp_path, config(hanging, name="hangs"), config(hook.url)):
        for _ in range(3):
            ended(service)
        until(lambda: len(hook.received) == 3)
        until(lambda: states(service.store).count(("plant-it", "delivered", 1)) == 3)
        assert states(service.store).count(("hangs", "waiting", 0)) == 3
        begun = time.monotonic()
    assert time.monotonic() - begun < 30.0, "nor the end of the service"


def test_no_answer_is_waited_for_so_long_only(hanging: str) -> None:
    with pytest.raises(NotDelivered, match=r"no answer within 0\.1 s"):
        post(hanging, {}, b"{}", timeout_s=0.1)


def test_a_redirect_is_not_followed(service: Service, tmp_path: Path, receiver: Callable[..., Receiver]) -> None:
    inside = receiver(200)
    hook = receiver(307, location=inside.url)
    with webhooks(service, tmp_path, config(hook.url)):
        ended(service)
        until(lambda: states(service.store) == [("plant-it", "given_up", 4)])
    assert not inside.received
    (message,) = webhook_deliveries.latest(service.store, 1)
    assert message.error is not None and "redirects are not followed" in message.error


def test_what_was_not_delivered_is_delivered_after_a_restart(
    service: Service, tmp_path: Path, receiver: Callable[..., Receiver]
) -> None:
    hook = receiver(200)
    later = DeliveryTimes(look_s=3600.0)
    with webhooks(service, tmp_path, config(hook.url), clock=later):
        until(lambda: not webhook_deliveries.waiting(service.store, "plant-it"))
        ended(service)
        assert states(service.store) == [("plant-it", "waiting", 0)], "stored with the end of the job"
    assert not hook.received
    with webhooks(service, tmp_path, config(hook.url)):
        until(lambda: states(service.store) == [("plant-it", "delivered", 1)])
    assert len(hook.received) == 1


def test_what_waits_for_a_webhook_that_is_gone_is_given_up(service: Service, tmp_path: Path, hanging: str) -> None:
    with webhooks(service, tmp_path, config(hanging), clock=DeliveryTimes(look_s=3600.0)):
        ended(service)
    with webhooks(service, tmp_path, config(hanging, name="another"), clock=DeliveryTimes(look_s=3600.0)):
        (message,) = webhook_deliveries.latest(service.store, 1)
    assert message.state is DeliveryState.GIVEN_UP and message.error == "the webhook is not configured any more"


def test_only_what_is_asked_for_is_sent_and_dry_runs_end_too(
    service: Service, tmp_path: Path, receiver: Callable[..., Receiver]
) -> None:
    hook = receiver(200)
    with webhooks(service, tmp_path, config(hook.url, events=["job.ended"])):
        ended(service)
        ended(service, dry_run=True)
        until(lambda: len(hook.received) == 1)
    message = json.loads(hook.received[0][1])
    assert message["data"]["dry_run"] and message["data"]["state"] == JobState.REHEARSED


def test_old_messages_are_deleted(service: Service, tmp_path: Path, receiver: Callable[..., Receiver]) -> None:
    with webhooks(service, tmp_path, config(receiver(200).url)):
        ended(service)
        until(lambda: states(service.store) == [("plant-it", "delivered", 1)])
    webhook_deliveries.delete_over(service.store, time.time() - 60.0)
    assert states(service.store)
    webhook_deliveries.delete_over(service.store, time.time() + 60.0)
    assert not states(service.store)


class Passing:
    """A wall clock that somebody sets, the time that passes, and a webhook's sender that goes by both."""

    def __init__(self, service: Service, folder: Path, url: str) -> None:
        self.now_s, self.passed_s = time.time(), 1000.0
        (folder / "secret").write_text(base64.b64encode(SECRET).decode())
        times = DeliveryTimes(lambda: self.now_s, lambda: self.passed_s)
        self.storing = Webhooks([config(url)], folder, service.store, None, times)
        self.sender = Sender(config(url), SECRET, service.store, times)

    def go_on(self, days: float) -> None:
        self.now_s, self.passed_s = self.now_s + 86_400.0 * days, self.passed_s + 86_400.0 * days
        self.sender.turn()


def test_a_clock_that_jumps_ahead_deletes_no_message(
    service: Service, tmp_path: Path, receiver: Callable[..., Receiver]
) -> None:
    clock = Passing(service, tmp_path, receiver(204).url)
    ended(service)
    clock.sender.turn()
    clock.now_s += 31 * 86_400.0
    for days in (0.1, 1.0, 28.0):
        clock.go_on(days)
        assert states(service.store) == [("plant-it", "delivered", 1)]
    clock.go_on(1.1)  # thirty days that the service itself has seen
    assert not states(service.store)


@pytest.mark.parametrize("back_s", [60.0, 3600.0, 86_400.0])
def test_a_message_does_not_wait_for_a_clock_that_is_set_back(
    back_s: float, service: Service, tmp_path: Path, receiver: Callable[..., Receiver]
) -> None:
    hook = receiver(500, 204)
    clock = Passing(service, tmp_path, hook.url)
    ended(service)
    clock.now_s -= back_s
    clock.sender.turn()
    assert states(service.store) == [("plant-it", "waiting", 1)] and len(hook.received) == 1
    clock.sender.turn()
    assert len(hook.received) == 1, "it is tried again after 5 s"
    clock.now_s -= back_s
    clock.sender.turn()
    assert states(service.store) == [("plant-it", "delivered", 2)]


@pytest.mark.parametrize(("entry", "why"), [
    ({"url": "http://example.com/hook"}, "url begins with http"),
    ({"url": "https://me:word@example.com/"}, "no name and no password"),
    ({"url": "example.com/hook"}, "an address of the form https://HOST/PATH"),
    ({"url": "https://example.com:0/hook"}, "an address of the form"),
    ({"url": "https://example.com/hook", "events": ["job.begun"]}, "'job.needs_decision' or 'job.ended' is expected"),
    ({"url": "https://example.com/hook", "retries": 3}, "unknown name"),
    ({"url": "https://example.com/hook", "secret_file": ""}, "secret_file"),
])  # fmt: skip
def test_what_a_webhook_in_loops_yaml_may_not_be(entry: dict[str, Any], why: str) -> None:
    document = {"loops": [loop_entry()], "webhooks": [{"name": "plant-it", "secret_file": "secret"} | entry]}
    with pytest.raises(ConfigError) as caught:
        parse_site(document, "loops.yaml")
    assert "webhooks[0]" in str(caught.value) and why in str(caught.value)
    assert "me:word" not in str(caught.value)


def test_webhooks_of_a_site_have_names_of_their_own() -> None:
    entry = {"name": "plant-it", "url": "https://example.com/hook", "secret_file": "secret"}
    assert parse_site({"loops": [loop_entry()], "webhooks": [entry]}, "").webhooks[0].origin == "https://example.com"
    with pytest.raises(ConfigError, match="'plant-it' is used by several webhooks"):
        parse_site({"loops": [loop_entry()], "webhooks": [entry, entry]}, "")


@pytest.mark.parametrize(("content", "why"), [
    (None, "No such file"), ("c2hvcnQ=", "has 5 bytes, 24 to 64 are expected"), ("not base64!", "is not base64"),
    ("gehört nicht hierher", "is not base64"),
])  # fmt: skip
def test_a_secret_that_cannot_be_used(content: str | None, why: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "secret").write_text(content)
    with pytest.raises(BadSecret) as caught:
        read_secret(config("https://example.com/hook"), tmp_path)
    assert why in str(caught.value) and (content is None or content not in str(caught.value))
