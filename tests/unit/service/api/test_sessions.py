"""Signing in with a key: the cookie, what a change with it must show, and how a session ends."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.api.gate.gate import Policy
from loopwright.service.api.gate.limits import RequestLimits
from loopwright.service.live import live as live_module
from loopwright.service.security.keys import Scope, new_key
from loopwright.service.security.sessions import IDLE_S, LASTS_S, BrowserSessions
from loopwright.service.store import audit
from loopwright.service.store.keyring import REVOKED_WITHIN_S, Keyring
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, Service
from tests.unit.service.live.test_live_stream import screens_of
from tests.unit.service.live_viewer import viewing

CSRF = "X-Loopwright-CSRF"
HOST = "plant.example"


class Browsers:
    """A service with keys, and browsers before it."""

    def __init__(self, service: Service) -> None:
        self.now = 0.0
        self.service = service
        self.keyring = Keyring(service.store.engine)
        self.sessions = BrowserSessions(lambda: self.now)
        self._clients: list[TestClient] = []

    def browser(self, scheme: str = "http", **limits: Any) -> TestClient:
        policy = Policy(self.keyring, RequestLimits(**limits), sessions=self.sessions)
        app = app_of(self.service.jobs, policy, {})
        self._clients.append(TestClient(app, base_url=f"{scheme}://{HOST}", raise_server_exceptions=False))
        return self._clients[-1]

    def signed_in(self, scope: Scope = Scope.OPERATE, name: str = "control room") -> TestClient:
        """The browser sends its proof with each request."""
        found = self.browser()
        answer = found.post("/session", json={"key": self.keyring.create(name, scope)[1]})
        assert answer.status_code == 200
        found.headers[CSRF] = answer.json()["csrf"]
        return found

    def trail(self) -> list[Any]:
        return [each for each in audit.trail(self.service.store.engine, 100) if each.what.startswith("sign")]

    def close(self) -> None:
        for client in self._clients:
            client.close()


@pytest.fixture
def browsers(service: Service) -> Iterator[Browsers]:
    found = Browsers(service)
    yield found
    found.close()


@pytest.mark.parametrize("scheme", ["http", "https"])
def test_the_cookie(browsers: Browsers, scheme: str) -> None:
    browser = browsers.browser(scheme)
    _, key = browsers.keyring.create("control room", Scope.OPERATE)
    assert browser.get("/session").status_code == browser.get("/loops").status_code == 401
    answer = browser.post("/session", json={"key": f" {key}\n"})
    said = answer.json()
    assert (said["name"], said["scope"], said["keys"]) == ("control room", "operate", True)
    name, *parts = [part.strip() for part in answer.headers["set-cookie"].split(";")]
    token = name.partition("=")[2]
    assert name.startswith("__Host-" if scheme == "https" else "loopwright_session=") and len(token) == 43
    assert {"HttpOnly", "SameSite=strict", "Path=/", f"Max-Age={LASTS_S:.0f}"} <= set(parts)
    assert ("Secure" in parts) is (scheme == "https") and not any("Domain" in part for part in parts)
    assert token not in answer.text and answer.headers["cache-control"] == "no-store"
    assert browser.get("/session").json() == said and browser.get("/loops").status_code == 200
    cookies = {"__Host-loopwright_session" if scheme == "http" else "loopwright_session": token}
    assert TestClient(browser.app, base_url=f"{scheme}://{HOST}", cookies=cookies).get("/loops").status_code == 401
    assert token not in repr(vars(browsers.sessions)) and key not in repr(vars(browsers.sessions))


@pytest.mark.parametrize(
    ("headers", "without", "status"),
    [
        ({}, False, 202),
        ({"Sec-Fetch-Site": "same-origin", "Origin": f"http://{HOST}"}, False, 202),
        ({"Origin": f"https://{HOST}"}, False, 202),
        ({}, True, 403),
        ({CSRF: "guessed"}, False, 403),
        ({CSRF: "gu\u00e9ssed"}, False, 403),
        ({"Sec-Fetch-Site": "cross-site"}, False, 403),
        ({"Sec-Fetch-Site": "same-site"}, False, 403),
        ({"Sec-Fetch-Site": "none"}, False, 403),
        ({"Origin": f"http://{HOST}:8081"}, False, 403),
        ({"Origin": "https://evil.example"}, False, 403),
        ({"Origin": "null"}, False, 403),
    ],
)
def test_what_a_change_must_show(browsers: Browsers, headers: dict[str, str], without: bool, status: int) -> None:
    browser = browsers.signed_in()
    if without:
        del browser.headers[CSRF]
    sent = {name: value.encode("latin-1") for name, value in headers.items()}
    answer = browser.post(f"/loops/{TAG}/retune", json={"by": "me"}, headers=sent)
    assert answer.status_code == status
    if status == 403:
        assert any(word in assert_problem(answer, 403)["detail"] for word in ("/session", "/ui/"))
        assert browsers.service.store.recent() == []
    assert browser.get("/loops", headers=sent).status_code == 200


def test_a_page_of_another_address_cannot_sign_in(browsers: Browsers) -> None:
    _, key = browsers.keyring.create("a", Scope.READ)
    browser = browsers.browser()
    for headers in ({"Origin": "https://evil.example"}, {"Sec-Fetch-Site": "cross-site"}):
        assert_problem(browser.post("/session", json={"key": key}, headers=headers), 403)
    form = browser.post("/session", content=json.dumps({"key": key}), headers={"Content-Type": "text/plain"})
    assert form.status_code == 415 and not browser.cookies


def test_bearer_keys_are_as_before(browsers: Browsers) -> None:
    browser = browsers.signed_in(Scope.READ)
    del browser.headers[CSRF]
    bearer = {"Authorization": f"Bearer {browsers.keyring.create('script', Scope.OPERATE)[1]}"}
    assert browser.get("/session", headers=bearer).json()["name"] == "script"
    assert browser.get("/session", headers=bearer).json()["csrf"] is None
    answer = browser.post(f"/loops/{TAG}/retune", json={"by": "me"}, headers=bearer | {"Origin": "https://any.example"})
    assert answer.status_code == 202
    assert_problem(browser.delete("/session", headers=bearer), 409)
    assert browser.get("/loops", headers={"Authorization": "Bearer wrong"}).status_code == 401


@pytest.mark.parametrize("has", Scope)
def test_scopes_are_those_of_the_key(browsers: Browsers, has: Scope) -> None:
    browser = browsers.signed_in(has)
    answer = browser.post(f"/loops/{TAG}/retune", json={"by": "me"})
    assert answer.status_code == (403 if has is Scope.READ else 202)
    assert browser.get("/audit").status_code == (200 if has is Scope.ADMIN else 403)


def test_signing_out(browsers: Browsers) -> None:
    browser = browsers.signed_in()
    cookie = dict(browser.cookies)
    assert browser.delete("/session", headers={CSRF: "guessed"}).status_code == 403
    assert browser.delete("/session").status_code == 204 and not browser.cookies
    browser.cookies.update(cookie)
    assert "sign in again" in assert_problem(browser.get("/loops"), 401)["detail"]
    assert [each.what for each in browsers.trail()] == ["sign_out", "sign_in"]
    assert {each.key for each in browsers.trail()} == {"control room"}


@pytest.mark.parametrize("scheme", ["http", "https"])
def test_two_services_on_one_host(browsers: Browsers, scheme: str) -> None:
    """A browser sends the cookies of a host to each of its ports."""
    one, other = (browsers.browser(scheme) for _ in range(2))
    one.base_url, other.base_url, other.cookies = f"{scheme}://{HOST}:8000", f"{scheme}://{HOST}:8001", one.cookies
    _, key = browsers.keyring.create("control room", Scope.OPERATE)
    said = [browser.post("/session", json={"key": key}).json()["csrf"] for browser in (one, other)]
    assert [browser.get("/session").json()["csrf"] for browser in (one, other)] == said
    assert other.delete("/session", headers={CSRF: said[1]}).status_code == 204
    assert (other.get("/session").status_code, one.get("/session").status_code) == (401, 200)


def test_a_restart_signs_out(browsers: Browsers) -> None:
    browser = browsers.signed_in()
    browsers.sessions = BrowserSessions()
    after = browsers.browser()
    after.cookies.update(dict(browser.cookies))
    assert "sign in again" in assert_problem(after.get("/session"), 401)["detail"]


@pytest.mark.parametrize(("step_s", "last_s"), [(IDLE_S - 1.0, LASTS_S), (IDLE_S, IDLE_S)])
def test_a_session_ends_by_itself(browsers: Browsers, step_s: float, last_s: float) -> None:
    browser = browsers.signed_in()
    while browsers.now + step_s < last_s:
        browsers.now += step_s
        assert browser.get("/session").status_code == 200
    browsers.now += step_s
    assert browser.get("/session").status_code == 401


@pytest.mark.parametrize("sign_out", [False, True])
def test_a_revoked_key_and_a_sign_out_end_sessions_and_streams(
    service: Service, browsers: Browsers, monkeypatch: pytest.MonkeyPatch, sign_out: bool
) -> None:
    monkeypatch.setattr(live_module, "REVOKED_WITHIN_S", 0.05)
    row, _ = browsers.keyring.create("a", Scope.READ)
    token, session = browsers.sessions.begin(row.id, row.name, Scope.READ)
    with (
        screens_of(service, Policy(browsers.keyring, sessions=browsers.sessions)) as screens,
        viewing(screens.base, Cookie=f"loopwright_session_{screens.base.rpartition(':')[2]}={token}") as viewer,
    ):
        viewer.until("hello")
        if sign_out:
            browsers.sessions.end(session.id)
        else:
            browsers.keyring.revoke(row.id)
        viewer.rest()
        assert "revoked" in viewer.comments[-1]


def test_a_revoked_key_ends_its_sessions(browsers: Browsers) -> None:
    browser, other = browsers.signed_in(), browsers.signed_in(name="other")
    Keyring(browsers.service.store.engine).revoke("control room")
    browsers.now += REVOKED_WITHIN_S + 0.01
    assert browser.get("/loops").status_code == browser.get("/loops").status_code == 401
    assert other.get("/loops").status_code == 200


def test_wrong_keys_are_slowed_down_and_written_down(browsers: Browsers) -> None:
    browser = browsers.browser(bad_keys_burst=3, bad_keys_per_s=0.01)
    row, key = browsers.keyring.create("control room", Scope.READ)
    wrong = key[:-4] + ("AAAA" if not key.endswith("AAAA") else "BBBB")
    answers = [browser.post("/session", json={"key": wrong}) for _ in range(12)]
    assert [answer.status_code for answer in answers] == [401] * 3 + [429] * 9
    assert int(answers[-1].headers["retry-after"]) > 60 and not browser.cookies
    bearer = {"Authorization": f"Bearer {new_key()[1]}"}
    assert browser.get("/loops", headers=bearer).status_code == 429  # the same guesses
    found = browsers.trail()
    assert [each.what for each in found] == ["sign_in_refused"] * 5  # and no more
    assert (found[-1].key, found[-1].subject) == ("unknown", row.id) and found[-1].after["key"] == "control room"
    assert not any(part in str([each.after for each in found]) for part in (wrong, wrong[16:]))


@pytest.mark.parametrize("body", [{}, {"key": ""}, {"key": 7}, {"key": "x" * 201}, {"key": "x", "more": 1}])
def test_a_body_that_is_no_key(browsers: Browsers, body: dict[str, Any]) -> None:
    assert_problem(browsers.browser().post("/session", json=body), 422)


def test_without_keys_there_is_nothing_to_sign_in_to(client: TestClient) -> None:
    assert_problem(client.post("/session", json={"key": "x"}), 409)
    assert_problem(client.delete("/session"), 409)


def test_an_idempotency_key_keeps_no_token(browsers: Browsers) -> None:
    _, key = browsers.keyring.create("a", Scope.READ)
    answers = [
        browsers.browser().post("/session", json={"key": key}, headers={"Idempotency-Key": "k"}) for _ in range(2)
    ]
    assert answers[0].headers["set-cookie"] != answers[1].headers["set-cookie"]


def test_the_number_of_sessions_is_bounded() -> None:
    sessions = BrowserSessions(lambda: 0.0, of_key=2, in_all=3)
    tokens = [sessions.begin(key, key, Scope.READ)[0] for key in ("a", "a")]
    assert sessions.of(tokens[0])
    tokens.append(sessions.begin("a", "a", Scope.READ)[0])
    assert [sessions.of(token) is not None for token in tokens] == [True, False, True]
    tokens += [sessions.begin(key, key, Scope.READ)[0] for key in ("b", "c")]
    assert [sessions.of(token) is not None for token in tokens] == [False, False, True, True, True]


def test_sessions_of_many_threads_stay_within_the_bound() -> None:
    sessions = BrowserSessions(of_key=5)
    found: list[str] = []
    work: Callable[[], None] = lambda: found.extend(sessions.begin("a", "a", Scope.READ)[0] for _ in range(50))  # noqa: E731
    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(sessions.of(token) is not None for token in found) == 5
