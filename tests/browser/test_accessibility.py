"""axe-core finds nothing on any view, in both palettes, wide and narrow: neither WCAG 2 A and AA nor best practice.

All views are of one service, with a test under way, a proposal that waits, a refusal, and loops that are abnormal.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser import person
from tests.browser.fleet import Fleet, Member, locked_service
from tests.browser.pages import WIDE, Pages

AXE = (Path(__file__).parent / "vendor" / "axe.min.js").read_text()
RULES = ("wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice")
NARROW = {"width": 430, "height": 900}
BELOW = MappingProxyType({"pv_limits": {"low": 50.2, "high": 52.0}})
PROPOSED, AT_REST, UNDER_TEST, REFUSED = "TIC-101", "LIC-130", "TIC-102", "FIC-220"
MEMBERS = (
    Member(PROPOSED, "Distillation", "Reboiler outlet temperature", "degC"),
    Member(UNDER_TEST, "Distillation", "Column top temperature", "degC", "model-41", 20.0, 12.0),
    Member(AT_REST, "Distillation", "Sump level", "%", "sopdt", 100.0, 12.0),
    Member(REFUSED, "Reactor", "Feed A", "m3/h", "model-14", 30.0, 2.0, noise=0.03),
    Member("FIC-320", "Utilities", "Cooling water", "m3/h", "model-14", 50.0, 2.0, changes=BELOW),
    Member("TIC-401", "Tank farm", "Heating of tank 4", "degC", on_dead_bus=True),
)


class States(Fleet):
    """The fleet in the states that the views show. proposed, refused, retune: URLs."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        super().__init__(stack, folder, MEMBERS, ts=0.1)
        self.pace(10.0)
        self.proposed = self.retune(by="M. Weber")
        answer = self.http.post("/batches", json={"pattern": "FIC-2*", "by": "M. Weber"})
        assert answer.status_code == 202, answer.text
        self.many = answer.headers["location"]
        assert self.finished(self.proposed)["state"] == "proposed"
        [refused] = self.http.get("/jobs", params={"loop": REFUSED}).json()
        self.refused = refused["url"]
        assert self.finished(self.refused)["state"] == "refused"
        self.pace(1.0)  # a test in five stages takes minutes
        self.under_test = self.retune(UNDER_TEST, method="five-stage", by="A. Lind")
        self.until(self.under_test, lambda job: job["stage"] not in (None, "preflight"))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[States]:
    with ExitStack() as stack:
        states = States(stack, tmp_path_factory.mktemp("states"))
        yield states
        states.http.post(f"{states.under_test}/abort")


def loops(pages: Pages, site: States) -> Page:
    page = pages.open(bypass_csp=True)
    expect(page.get_by_role("link", name=re.compile(r"\d active alarm"))).to_be_visible()
    expect(page.get_by_role("row", name=AT_REST)).to_be_visible()
    return page


def at_rest(pages: Pages, site: States) -> Page:
    page = pages.open(f"/ui/loops/{AT_REST}", bypass_csp=True)
    page.get_by_role("button", name="More options").click()
    expect(page.get_by_text("It ends by itself if PV leaves")).to_be_visible()
    return page


def under_test(pages: Pages, site: States) -> Page:
    page = pages.open(f"/ui/loops/{UNDER_TEST}", bypass_csp=True)
    expect(person.under_test(page).locator(person.STEP)).to_be_visible()
    return page


def result(pages: Pages, site: States) -> Page:
    page = pages.open(f"/ui/loops/{PROPOSED}", bypass_csp=True)
    expect(page.get_by_role("img", name="What the model leaves")).to_be_visible()
    return page


def decision(pages: Pages, site: States) -> Page:
    page = result(pages, site)
    page.get_by_role("button", name="Accept the new gains…").click()
    expect(person.decision(page).get_by_label("Your name")).to_be_focused()
    return page


def refused(pages: Pages, site: States) -> Page:
    page = pages.open(f"/ui{site.refused}", bypass_csp=True)
    expect(person.headline(page)).to_contain_text("Refused: ")
    return page


def jobs(pages: Pages, site: States) -> Page:
    page = pages.open("/ui/jobs", bypass_csp=True)
    expect(page.get_by_role("row")).to_have_count(4)
    return page


def many(pages: Pages, site: States) -> Page:
    page = pages.open("/ui/batches", bypass_csp=True)
    page.get_by_role("textbox", name="Loops").fill("*IC-*")
    expect(page.get_by_role("button", name=re.compile(r"Retune \d loops"))).to_be_visible()
    return page


def one_of_many(pages: Pages, site: States) -> Page:
    page = pages.open(f"/ui{site.many}", bypass_csp=True)
    expect(page.get_by_role("row", name=REFUSED)).to_be_visible()
    return page


def alarm(pages: Pages, site: States) -> Page:
    page = pages.open("/ui/alarms", bypass_csp=True)
    expect(page.get_by_role("row").nth(2)).to_be_visible()
    return page


def log(pages: Pages, site: States) -> Page:
    page = pages.open("/ui/log", bypass_csp=True)
    expect(page.get_by_role("row", name=REFUSED).first).to_be_visible()
    return page


def keys(pages: Pages, site: States) -> Page:
    page = jobs(pages, site)
    page.keyboard.press("?")
    expect(page.get_by_role("dialog", name="Keys")).to_be_visible()
    return page


def report(pages: Pages, site: States) -> Page:
    page = pages.open(f"{site.proposed}/report", bypass_csp=True)
    expect(page.get_by_role("heading", level=1)).to_be_visible()
    return page


VIEWS: tuple[Callable[[Pages, States], Page], ...] = (
    loops, at_rest, under_test, result, decision, refused, jobs, many, one_of_many, alarm, log, keys, report,
)  # fmt: skip


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.__name__)
def test_nothing_is_found(pages: Pages, site: States, view: Callable[[Pages, States], Page]) -> None:
    page = view(pages, site)
    found = found_on(page)
    assert not found, "\n".join(found)


def test_nothing_is_found_where_one_signs_in(site: States, pages: Pages, tmp_path: Path) -> None:
    with ExitStack() as stack:
        pages.url = locked_service(stack, tmp_path)
        with pages.expecting("status of 401"):
            page = pages.open(bypass_csp=True)
            expect(page.get_by_label("API key")).to_be_focused()
        found = found_on(page)
        assert not found, "\n".join(found)


def found_on(page: Page) -> list[str]:
    """What axe finds in each palette and width, as lines. axe needs evaluation, which the policy does not permit."""
    page.evaluate(AXE)
    found = []
    for width in (WIDE, NARROW):
        page.set_viewport_size(width)
        for palette in ("light", "dark"):
            page.emulate_media(color_scheme=palette, reduced_motion="reduce")
            answer: dict[str, Any] = page.evaluate(
                "(tags) => axe.run(document, { runOnly: { type: 'tag', values: tags }, resultTypes: ['violations'] })",
                list(RULES),
            )
            for each in answer["violations"]:
                what = f"{palette}, {width['width']} px: {each['impact']} {each['id']}"
                found += [f"{what}: {node['target']} {node['failureSummary']}" for node in each["nodes"]]
    return found
