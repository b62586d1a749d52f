"""The browser's clock is wrong, and a tab that nobody sees."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

import pytest
from playwright.sync_api import Page, expect

from tests.browser import person
from tests.browser.pages import Pages
from tests.browser.site import TAG, Site

HIDE = """(hidden) => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => hidden });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


@pytest.mark.parametrize("wrong_h", [-1, 1])
def test_ages_are_of_the_service_and_what_is_live_is_live(site: Site, pages: Pages, wrong_h: int) -> None:
    site.finished(site.retune())
    context = pages.context()
    context.clock.install(time=datetime.now(UTC) + timedelta(hours=wrong_h))
    page = pages.another(context)
    row = page.get_by_role("row", name=TAG)
    expect(row).to_contain_text(re.compile(r"awaiting decision\s*(just now|\d+.s ago|[1-5].min ago)"))
    expect(row.locator(".pvnum")).to_have_text(re.compile(r"^50\.0"))
    person.open_loop(page)
    expect(person.face(page).locator(".mode").first).to_have_text("AUTO")
    expect(page.get_by_text("Service offline")).to_have_count(0)
    plot = page.get_by_role("img", name=f"PV and set-point of {TAG}")
    expect(plot.locator("canvas")).to_be_visible()


def test_a_tab_that_nobody_sees_gives_its_stream_up_and_comes_back(site: Site, pages: Pages) -> None:
    context = pages.context()
    context.clock.install()
    page: Page = pages.another(context)
    pv = page.get_by_role("row", name=TAG).locator(".pvnum")
    expect(pv).to_have_text(re.compile(r"^50\.0"))
    page.evaluate(HIDE, True)
    with page.expect_event("requestfailed", lambda request: "/live" in request.url):
        page.clock.fast_forward("01:05")
    site.write("controller_setpoint", site.case.sp + 0.05)
    with page.expect_request("**/live*"):
        page.evaluate(HIDE, False)
    expect(page.get_by_role("row", name=TAG).locator(".c-sp")).to_have_text("50.050")
    expect(page.get_by_text("Service offline")).to_have_count(0)
