"""From the loops to a test and its abort, with the keyboard alone."""

from __future__ import annotations

from playwright.sync_api import Locator, Page, expect

from tests.browser import person
from tests.browser.site import TAG, Site

MOST_TABS = 60


def tab_to(page: Page, wanted: Locator) -> None:
    """Tab, until it has the focus."""
    for _ in range(MOST_TABS):
        if wanted.evaluate("(element) => element === document.activeElement"):
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"not reached: {wanted}")


def test_a_retune_is_started_and_aborted(site: Site, page: Page) -> None:
    site.write("plant_pace", 1.0)
    expect(page.get_by_role("row", name=TAG)).to_be_visible()
    page.keyboard.press("/")
    page.keyboard.type(TAG)
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name=TAG)).to_be_visible()
    opener = page.get_by_role("button", name="Retune…")
    expect(page.get_by_role("region", name="Retune").or_(opener).first).to_be_visible()
    if opener.is_visible():
        tab_to(page, opener)
        page.keyboard.press("Enter")
    signed = person.form(page).get_by_label("Your name")
    tab_to(page, signed)
    page.keyboard.press("ControlOrMeta+a")
    page.keyboard.type(person.NAME)
    expect(page.get_by_role("button", name=f"Retune {TAG}")).to_be_enabled()
    page.keyboard.press("Enter")  # in the name field
    expect(person.under_test(page)).to_contain_text(f"Asked for by {person.NAME}")
    expect(person.under_test(page)).to_be_focused()
    person.in_stage(page, "Relay test")
    page.keyboard.press("Control+.")
    expect(person.headline(page)).to_contain_text("Aborted: by an operator")
    assert site.is_home()
