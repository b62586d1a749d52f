"""GET /jobs/{id}/report: one HTML file that needs nothing else, for every end of a job."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from loopwright.service.api.job_views import JobView
from loopwright.service.api.report import numbers
from loopwright.service.api.report.drawing import around, ticks
from loopwright.service.api.report.fingerprint import FIELDS
from loopwright.service.api.report.words import mark_names, stage_name
from loopwright.service.results import GainsView
from loopwright.tuning.reasons import ADVICE, Failed, Reason, Refused
from tests.unit.service import fakes
from tests.unit.service.api.test_api import assert_problem, finished, start
from tests.unit.service.fakes import NEW, OLD, RESULT, Service

MARKUP = "<script>alert(1)</script> & <!-- \"'"
VOID = {"meta", "link", "img", "br", "hr", "input", "base"}


class Document(HTMLParser):
    """The elements and the text of an HTML document."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.style = ""
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == [], "every element is closed"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open[-1:] == ["style"]:
            self.style += data
        else:
            self.text += data

    def handle_comment(self, data: str) -> None:
        raise AssertionError(f"a comment: {data}")


def report(client: TestClient, job: str) -> tuple[Any, Document]:
    answer = client.get(f"/jobs/{job}/report")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    return answer, Document(answer.text)


def assert_self_contained(answer: Any, document: Document) -> None:
    # an empty icon of its own, without which a browser asks the server for one
    links = [attributes for tag, attributes in document.elements if tag == "link"]
    assert links == [{"rel": "icon", "href": "data:,"}]
    tags = {tag for tag, _ in document.elements}
    assert not tags & {"script", "img", "iframe", "object", "embed", "base", "form", "image", "use", "a"}
    for tag, attributes in document.elements:
        if tag == "link":
            continue
        for name, value in attributes.items():
            assert not name.startswith("on") and name not in ("style", "href", "src", "xlink:href", "srcset")
            assert "//" not in (value or "") and "javascript:" not in (value or "")
            for target in re.findall(r"url\((.*?)\)", value or ""):
                assert ("clippath", target) in [(tag, f"#{of.get('id')}") for tag, of in document.elements]
    assert not re.search(r"url\(|@import|//", document.style)
    digest = base64.b64encode(hashlib.sha256(document.style.encode()).digest()).decode()
    policy = answer.headers["content-security-policy"].split("; ")
    assert {"default-src 'none'", f"style-src 'sha256-{digest}'", "frame-ancestors 'none'", "sandbox"} <= set(policy)
    assert "unsafe" not in " ".join(policy)
    (meta,) = [of["content"] for tag, of in document.elements if of.get("http-equiv") == "Content-Security-Policy"]
    assert set((meta or "").split("; ")) <= set(policy)


def recomputed(client: TestClient, job: str) -> str:
    """The hash as docs/rest.md has it, from what the API answers."""
    shown = client.get(f"/jobs/{job}").json()
    part = json.dumps({name: shown[name] for name in FIELDS}, sort_keys=True, separators=(",", ":"))
    samples = client.get(f"/jobs/{job}/samples?format=csv").content
    return hashlib.sha256(part.encode() + samples).hexdigest()


def test_a_proposal(service: Service, client: TestClient) -> None:
    job = finished(service, client, by="A. Lind")
    answer, document = report(client, job["id"])
    assert_self_contained(answer, document)
    assert "New gains are proposed" in document.text and "A. Lind" in document.text
    for gains in (OLD, NEW):
        assert numbers.significant(gains.Kp) in document.text and numbers.significant(gains.Ti) in document.text
    assert "all quiet" in document.text.lower() and job["id"] in document.text
    name = answer.headers["content-disposition"]
    assert name == f'inline; filename="loopwright-{job["loop"]}-{job["id"]}.html"'
    pictures = [of["aria-label"] for tag, of in document.elements if tag == "svg" and of.get("role") == "img"]
    assert {"PV measured, set-point and model", "MV", "PV after a set-point step", "Nyquist plot"} <= set(pictures)


def test_the_hash_is_recomputed_and_outlives_the_decision(service: Service, client: TestClient) -> None:
    job = finished(service, client)["id"]
    expected = recomputed(client, job)
    assert expected in report(client, job)[1].text
    client.post(f"/jobs/{job}/accept", json={"by": "C. Berg"})
    _, document = report(client, job)
    assert expected == recomputed(client, job) and expected in document.text
    assert "The new gains were accepted by C. Berg" in document.text
    client.post(f"/jobs/{job}/rollback", json={"by": "D. Roth"})
    text = report(client, job)[1].text
    assert "The new gains were accepted first, and the previous ones put back by D. Roth" in text
    assert "The previous gains were kept" not in text
    fakes.add_samples(service.store, job, "relay", service.store.samples(job)[0][1][:1])
    assert recomputed(client, job) != expected and recomputed(client, job) in report(client, job)[1].text


def test_markup_in_what_people_and_devices_say_stays_text(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fakes, "RESULT", RESULT.model_copy(update={"notes": [MARKUP], "design": {MARKUP: 1.0}}))
    told = {"description": MARKUP, "pv_unit": MARKUP, "area": MARKUP}
    config = service.loops["TIC-101"].model_copy(update=told)
    monkeypatch.setitem(service.loops, "TIC-101", config)
    job = finished(service, client, by=MARKUP)["id"]
    client.post(f"/jobs/{job}/accept", json={"by": MARKUP})
    answer, document = report(client, job)
    assert_self_contained(answer, document)
    assert document.text.count("<script>alert(1)</script>") >= 5


@pytest.mark.parametrize(
    ("ends", "headline"),
    [
        (Refused(Reason.NOT_AT_REST, "PV moved by 3 <degC>"), "Refused: not at rest"),
        (Failed(Reason.NODE_LOST, "node 32 does not answer"), "Failed: node lost"),
        (RuntimeError("defect"), "Failed: an error inside the service"),
    ],
)
def test_a_job_without_a_proposal(service: Service, client: TestClient, ends: Exception, headline: str) -> None:
    service.tune.ends = ends
    job = finished(service, client)
    answer, document = report(client, job["id"])
    assert_self_contained(answer, document)
    assert headline in document.text and job["detail"][1:] in document.text  # a sentence begins with a capital
    assert ADVICE[Reason(job["reason"])] in document.text
    assert recomputed(client, job["id"]) in document.text


def test_a_job_stopped_by_somebody(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    job = start(client)
    assert service.tune.inside.wait(20.0)
    client.post(f"/jobs/{job}/abort", json={"by": "B. Holm"})
    service.wait(job)
    answer, document = report(client, job)
    assert_self_contained(answer, document)
    assert "Aborted: by an operator" in document.text and "B. Holm" in document.text
    assert "At the end the loop was read back: automatic" in document.text


def test_a_dry_run_and_a_job_that_never_began(service: Service, client: TestClient) -> None:
    rehearsed = finished(service, client, dry_run=True)
    answer, document = report(client, rehearsed["id"])
    assert_self_contained(answer, document)
    assert "Report of a dry run" in document.text and "There is no record" in document.text
    service.controller.absent = Reason.NODE_LOST
    lost = finished(service, client)
    answer, document = report(client, lost["id"])
    assert_self_contained(answer, document)
    assert "Node 32 does not answer." in document.text


def test_gains_that_are_not_stable_on_the_model(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    wild = GainsView(Kp=50.0, Ti=1.0, Td=0.0, Tf=0.0, b=1.0, c=0.0)
    monkeypatch.setattr(fakes, "RESULT", RESULT.model_copy(update={"new_gains": wild}))
    job = finished(service, client)["id"]
    answer, document = report(client, job)
    assert_self_contained(answer, document)
    assert "not stable" in document.text


def test_the_document_has_the_fields_of_the_hash() -> None:
    text = (Path(__file__).parents[4] / "docs" / "rest.md").read_text(encoding="utf-8")
    (listed,) = re.findall(r'FIELDS = """(.*?)"""', text, re.DOTALL)
    assert tuple(listed.split()) == FIELDS and set(FIELDS) <= set(JobView.model_fields)


def test_no_job_no_report(client: TestClient) -> None:
    assert_problem(client.get("/jobs/none/report"), 404)


def test_ticks_and_ranges() -> None:
    assert [text for _, text in ticks(0.0, 1.0, 5.0)] == ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
    assert [text for _, text in ticks(-30.0, 40.0, 4.0)] == ["−20", "0", "20", "40"]
    low, high = around([np.asarray([1e6, 1e6])], 0.0)
    assert low < 1e6 < high
    assert around([np.asarray([np.nan])], 2.0)[0] < 0.0


@pytest.mark.parametrize(
    ("value", "text"),
    [(58.4912, "58.49"), (0.0, "0"), (-0.00001234, "−1.234e−5"), (2.5e7, "2.500e7"), (None, "–"), (float("nan"), "–")],
)
def test_numbers(value: float | None, text: str) -> None:
    assert numbers.significant(value) == text


def test_a_step_that_follows_a_relay_is_said_not_to_begin_at_rest() -> None:
    """Its overshoot in the picture is not that of the gains."""
    assert mark_names(["preflight", "relay", "design", "verify"])[-1] == "Set-point step, from where the relay left PV"
    assert (
        mark_names(["preflight", "pulses", "design", "verify"])[-1] == "Set-point step, from where the pulses left PV"
    )
    assert mark_names(["preflight", "verify"])[-1] == stage_name("verify")
