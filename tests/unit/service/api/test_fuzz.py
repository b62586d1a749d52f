"""The OpenAPI document against the service: every operation, fed with what its schema allows and with what it forbids.

No answer may be a 5xx, and none may be undocumented in status, media type, headers or shape. The examples are the same
at every run; how many there were is in the run's summary. There are 2,000; LOOPWRIGHT_FUZZ_CASES=50000 tries more.
"""

from __future__ import annotations

import json
import os
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import timedelta
from pathlib import Path
from typing import Any, cast

import pytest
from anyio.from_thread import start_blocking_portal
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from loopwright.service.api.gate.gate import Policy
from loopwright.service.api.gate.limits import RequestLimits
from loopwright.service.inputs.request import FastRetune
from loopwright.service.listening.listening import Listening
from loopwright.service.live.live import Live
from loopwright.service.security.keys import Scope
from loopwright.service.store.keyring import Keyring
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, Service

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import schemathesis
    from schemathesis import GenerationMode
    from schemathesis.checks import not_a_server_error
    from schemathesis.specs.openapi import checks

DOCUMENT = json.loads((Path(__file__).parents[3] / "golden" / "openapi.json").read_text())
SCHEMA = schemathesis.openapi.from_dict(DOCUMENT)
OPERATIONS = {found.ok().label: found.ok() for found in cast(Any, SCHEMA).get_all_operations()}
WITH_INPUT = [
    f"{method.upper()} {path}"
    for path, item in DOCUMENT["paths"].items()
    for method, operation in item.items()
    if operation.get("parameters") or operation.get("requestBody")
]
pytestmark = pytest.mark.timeout(600)  # each test is hundreds of requests
WITH_KEYS = 200
EACH = max(40, (int(os.environ.get("LOOPWRIGHT_FUZZ_CASES", "2000")) - WITH_KEYS) // (2 * len(WITH_INPUT)))
"""Cases of an operation that the document allows, and as many that it forbids."""
CHECKS = [
    not_a_server_error,
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_headers_conformance,
    checks.response_schema_conformance,
]
BOUNDED = settings(
    derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=False
)
ABORT = "POST /jobs/{job_id}/abort"
_NUMBER = st.floats(allow_nan=False, allow_infinity=False) | st.floats(0.01, 100.0)
# Of the models that the document allows nearly all are no plant's, and would be refused at once.
BODIES = {
    "POST /tunings": st.fixed_dictionaries(
        {
            "model": st.fixed_dictionaries({"K": _NUMBER, "T_s": _NUMBER, "L_s": _NUMBER})
            | st.fixed_dictionaries(
                {"K": st.floats(0.1, 10.0), "T_s": st.floats(0.1, 10.0), "L_s": st.floats(0.1, 10.0)}
            )
            | st.fixed_dictionaries({"K": _NUMBER, "L_s": _NUMBER, "integrating": st.just(True)}),
            "method": st.sampled_from(["simc", "amigo", "lambda", "kappa-tau", "direct-synthesis", "robust"]),
        }
    ),
}
ABORT_MANY = "POST /batches/{batch_id}/abort"
RETUNES = ("POST /loops/{tag}/retune", "POST /batches")
RETUNES_MANY = ("POST /batches", "POST /batches/preview")
MANY = {"pattern": "*", "by": "M. Weber"}
KEYS = ("none", "wrong", "revoked", "expired", *Scope)


class Site:
    """A service with a job of every end, and with keys of every kind."""

    def __init__(self, folder: Path, authenticated: bool) -> None:
        self.service = Service(folder)
        keyring = Keyring(self.service.store.engine)
        limits = RequestLimits(rate_per_s=1e6, burst=10**6, bad_keys_per_s=1e6, bad_keys_burst=10**6)
        policy = Policy(keyring if authenticated else None, limits)
        listening = Listening(self.service.jobs.directory.loops, self.service.store, on=False)
        live = Live(self.service.jobs, listening)
        live.close()  # its streams, which would never end, end after their first messages
        app = app_of(self.service.jobs, policy, listening=listening, live=live)
        self.client = TestClient(app, raise_server_exceptions=False)
        self._open = ExitStack()
        # One event loop for all cases: the client would make one, in a thread of its own, for each.
        self.client.portal = self._open.enter_context(start_blocking_portal())
        self.keys = {scope.value: keyring.create(scope, scope)[1] for scope in Scope}
        self.keys["expired"] = keyring.create("old", Scope.ADMIN, timedelta(days=-1))[1]
        revoked, self.keys["revoked"] = keyring.create("revoked", Scope.ADMIN)
        keyring.revoke(revoked.id)
        self.keys["wrong"] = self.keys["admin"][:-4] + "AAAA"
        self.jobs = [self.ended(None), self.ended(None), self.ended(Failed(Reason.NODE_LOST, "silent"))]
        self.batches: list[str] = []
        self.alarms: list[str] = []
        self.cases = 0

    def ended(self, how: Exception | None) -> str:
        self.service.tune.ends = how
        job = self.service.jobs.start(TAG, FastRetune()).id
        self.service.wait(job)
        self.service.tune.ends = None
        return job

    def running(self) -> str:
        """A job that is in the middle of its experiment; the one before it ends first."""
        self.service.tune.hold.set()
        for row in self.service.store.unfinished():
            self.service.wait(row.id)
        self.service.tune.inside.clear()
        self.service.tune.hold.clear()
        job = self.service.jobs.start("FIC-2", FastRetune()).id
        assert self.service.tune.inside.wait(60)
        return job

    def retune(self, new: bool) -> str:
        """A batch that is open; the service's thread for them does not run here."""
        if new or not self.batches:
            self.batches.append(self.client.post("/batches", json=MANY).json()["id"])
        return self.batches[-1]

    def alarm(self) -> str:
        """An alarm that may be acknowledged, or where there is none one that was."""
        for each in self.client.get("/alarms").json():
            self.alarms.append(each["id"])
        return self.alarms[-1]

    def send(self, case: Any, **headers: str) -> Any:
        """The case as a request; its answer, checked against the document."""
        sent = case.as_transport_kwargs(base_url="http://testserver", headers=headers)
        body = {"content" if name == "data" else name: sent[name] for name in ("json", "data") if name in sent}
        # Bytes, as they go over the wire: httpx takes text for ASCII.
        named = {name: str(value).encode("latin-1") for name, value in sent["headers"].items()}
        answer = self.client.request(sent["method"], sent["url"], params=sent["params"], headers=named, **body)
        case.validate_response(answer, checks=CHECKS)
        self.cases += 1
        return answer

    def close(self) -> None:
        self.client.close()
        self._open.close()
        self.service.close()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, fuzz_count: Counter[str]) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("open"), authenticated=False)
    yield site
    fuzz_count["cases without keys"] += site.cases
    fuzz_count["operations"] += len(OPERATIONS)
    site.close()


@pytest.mark.parametrize("label", OPERATIONS)
def test_what_the_document_allows(label: str, site: Site) -> None:
    operation = OPERATIONS[label]
    seen: dict[int, str] = {}

    @settings(BOUNDED, max_examples=EACH)
    @given(
        case=operation.as_strategy(GenerationMode.POSITIVE),
        known=st.just(True) if label in RETUNES_MANY else st.booleans(),  # of few bodies none may name loops
        pick=st.integers(0, 2),
        body=BODIES.get(label, st.none()),
    )
    def run(case: Any, known: bool, pick: int, body: Any) -> None:
        site.service.jobs.locking.unlock(TAG, "nobody")  # what an example before may have locked
        if known:  # else nearly every answer would be a 404
            retune = site.retune(label == ABORT_MANY) if "batch_id" in case.path_parameters else ""
            alarm = site.alarm() if "alarm_id" in case.path_parameters else ""
            job = site.running() if label == ABORT else site.jobs[pick]
            names = {"alarm_id": alarm, "tag": TAG, "job_id": job, "batch_id": retune}
            if label in RETUNES_MANY:
                case.body.pop("loops", None)
                case.body["pattern"] = "*"
            if label in RETUNES and isinstance(case.body, dict):
                case.body["by"] = "M. Weber"  # no key names the caller
            case.body = case.body if body is None else body
            case.path_parameters.update({k: v for k, v in names.items() if k in case.path_parameters})
        answer = site.send(case)
        seen[answer.status_code] = answer.text

    run()
    assert seen.keys() & {200, 202, 409}, f"only refusals were tried, the last of each status: {seen}"


@pytest.mark.parametrize("label", WITH_INPUT)
def test_what_the_document_forbids(label: str, site: Site) -> None:
    refused = 0

    @settings(BOUNDED, max_examples=EACH)
    @given(case=OPERATIONS[label].as_strategy(GenerationMode.NEGATIVE))
    def run(case: Any) -> None:
        nonlocal refused
        refused += site.send(case).status_code >= 400

    run()
    assert refused


def test_each_operation_asks_for_its_key(tmp_path: Path, fuzz_count: Counter[str]) -> None:
    site = Site(tmp_path, authenticated=True)
    seen: Counter[int] = Counter()

    def with_every_key(label: str) -> None:
        @settings(BOUNDED, max_examples=1)
        @given(case=OPERATIONS[label].as_strategy(GenerationMode.POSITIVE))
        def run(case: Any) -> None:
            for key in KEYS:
                headers = {} if key == "none" else {"Authorization": f"Bearer {site.keys[key]}"}
                status = site.send(case, **headers).status_code
                seen[status] += 1
                expected = None if label == "GET /healthz" else _refusal(key, label)
                assert expected == status if expected else status not in (401, 403), f"{label}, key {key}: {status}"

        run()

    for label in sorted(OPERATIONS):
        with_every_key(label)
    site.close()
    fuzz_count["cases with keys"] += site.cases
    assert {200, 401, 403} <= seen.keys()


def _refusal(key: str, label: str) -> int | None:
    """Written from the table in docs/operations.md, not from the code."""
    if label == "POST /session":  # needs no key in its head; that in its body is made up
        return 401
    if key not in list(Scope):
        return 401
    reads = (
        label.startswith("GET ") or label == "DELETE /session" or label == "POST /tunings" or label.endswith("/preview")
    )
    needs = "admin" if label == "GET /audit" else "read" if reads else "operate"
    permitted = {"read": ("read",), "operate": ("read", "operate"), "admin": ("read", "operate", "admin")}
    return None if needs in permitted[key] else 403
