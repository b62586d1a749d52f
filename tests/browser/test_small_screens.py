"""A tablet and a phone: nothing is wider than the screen, and Abort is in view on every view while a loop is tested."""

from __future__ import annotations

import pytest
from playwright.sync_api import Page, expect

from tests.browser import person
from tests.browser.pages import Pages
from tests.browser.site import ABSENT, TAG, Site

TABLET, PHONE = {"width": 820, "height": 1180}, {"width": 360, "height": 740}
LONGER_THAN_THE_SCREEN = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


def fits(page: Page) -> None:
    expect(page.locator("main .calm")).to_have_count(0)  # what was asked for has come
    assert page.evaluate(LONGER_THAN_THE_SCREEN) <= 0, page.url


@pytest.mark.parametrize("size", [TABLET, PHONE], ids=["tablet", "phone"])
def test_every_view_fits(site: Site, pages: Pages, size: dict[str, int]) -> None:
    result = site.finished(site.retune())
    assert site.http.post("/batches", json={"by": "me", "pattern": ABSENT["tag"]}).status_code == 202
    [many] = site.ask("/batches?limit=1")
    page = pages.open(viewport=size)
    expect(page.locator(".loops")).to_be_visible()
    fits(page)
    page.goto(f"/ui/loops/{TAG}")
    expect(person.decision(page)).to_be_visible()
    fits(page)
    page.get_by_role("button", name="Accept the new gains…").click()
    fits(page)
    person.form(page)
    page.get_by_role("button", name="More options").click()
    fits(page)
    for path, name in (
        (result["url"], TAG),
        ("/jobs", "Jobs"),
        ("/batches", "Batches"),
        (many["url"], "Batch of 1 loop"),
        ("/alarms", "Alarms"),
        ("/log", "Log"),
    ):
        page.goto(f"/ui{path}")
        expect(page.get_by_role("heading", level=1, name=name)).to_be_visible()
        fits(page)


@pytest.mark.parametrize("size", [TABLET, PHONE], ids=["tablet", "phone"])
def test_Abort_is_in_view_wherever_one_is(site: Site, pages: Pages, size: dict[str, int]) -> None:
    site.write("plant_pace", 1.0)
    page = pages.open(f"/ui/loops/{TAG}", viewport=size)
    url = site.retune(method="five-stage")
    expect(person.under_test(page)).to_be_visible()
    for path in (f"/loops/{TAG}", "/", "/jobs", "/log"):
        page.goto(f"/ui{path}")
        expect(person.abort_button(page)).to_be_in_viewport(ratio=1)
        box = person.abort_button(page).bounding_box()
        assert box is not None and box["height"] >= 44, box
        fits(page)
    person.abort_button(page).click()
    assert site.finished(url)["state"] == "aborted"
    expect(person.dock(page)).to_have_count(0)
