"""The overview of all loops."""

from __future__ import annotations

import re

from playwright.sync_api import Page, expect

from tests.browser import person
from tests.browser.person import DASH
from tests.browser.site import ABSENT, TAG, Site


def test_the_loop_is_live(site: Site, page: Page) -> None:
    row = page.get_by_role("row", name=TAG)
    expect(row.locator(".pvnum")).to_have_text(re.compile(r"^50\.0\d\d$"))


def test_a_loop_is_found_and_opened(site: Site, page: Page) -> None:
    rows = page.locator("tr.row")
    expect(rows).to_have_count(2)
    page.keyboard.press("/")
    expect(page.get_by_label("Find a loop")).to_be_focused()
    page.keyboard.type("jacket")  # of its description
    expect(rows).to_have_count(1)
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name=TAG)).to_be_visible()
    expect(person.face(page).locator(".big")).to_have_text(re.compile(r"^50\.0\d\d$"))
    page.go_back()
    page.get_by_label("Find a loop").fill("nothing of that name")
    expect(page.get_by_text("No loop is found by this.")).to_be_visible()
    page.get_by_label("Find a loop").fill("")
    page.get_by_role("button", name="Column").click()
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text(ABSENT["tag"])


def test_a_loop_that_was_never_heard_is_abnormal_and_shows_dashes(site: Site, page: Page) -> None:
    row = page.get_by_role("row", name=ABSENT["tag"])
    expect(row.locator(".pvnum")).to_have_text(DASH)
    expect(row).to_contain_text("No data since the bus is up")
    expect(page.get_by_role("link", name="1 active alarm")).to_be_visible()
    page.get_by_label("needs attention").check()
    expect(row).to_be_visible()
    page.get_by_role("link", name="1 active alarm").click()
    expect(page.get_by_role("row", name=ABSENT["tag"])).to_contain_text("No data since the bus is up")


def test_pv_moves_on_the_page_as_it_moves_in_the_plant(site: Site, page: Page) -> None:
    person.open_loop(page)
    site.write("controller_setpoint", 50.2)
    expect(person.face(page).locator(".mid").first).to_contain_text("50.200")
    expect(person.face(page).locator(".big")).to_have_text(re.compile(r"^50\.(19|20)\d$"))
