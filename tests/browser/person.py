"""What a person does and reads on the page, by the names that are on it."""

from __future__ import annotations

import re

from playwright.sync_api import Locator, Page, expect

from tests.browser.site import TAG

NAME = "A. Lind"
DASH = "–"
STEP = '[aria-current="step"]'


def open_loop(page: Page, tag: str = TAG) -> None:
    """Opens a loop from the overview, and waits for its live values."""
    page.get_by_role("main").get_by_role("link", name=tag).click()
    expect(page.get_by_role("heading", name=tag)).to_be_visible()
    expect(present(page, tag).locator(".big")).not_to_have_text(DASH)


def face(page: Page, tag: str = TAG) -> Locator:
    return page.get_by_role("region", name=f"Present values of {tag}")


def present(page: Page, tag: str = TAG) -> Locator:
    """The face of a loop while its values are present ones, not old."""
    return face(page, tag).and_(page.locator(":not(.old)"))


def sign(page: Page, name: str = NAME) -> None:
    page.get_by_label("Your name").fill(name)


def form(page: Page) -> Locator:
    """The form of a retune, opened where it is not open by itself: on a loop that has a result."""
    found = page.get_by_role("region", name="Retune")
    opener = page.get_by_role("button", name="Retune…")
    expect(found.or_(opener).first).to_be_visible()
    if opener.is_visible():
        opener.click()
    return found


def retune(page: Page, tag: str = TAG) -> None:
    """Fills in the form, starts the test, and waits until the page shows it."""
    form(page)
    sign(page)
    page.get_by_role("button", name=f"Retune {tag}").click()
    expect(under_test(page)).to_be_visible()


def under_test(page: Page) -> Locator:
    return page.get_by_role("region", name="Under test")


def dock(page: Page) -> Locator:
    return page.get_by_role("region", name="Jobs under way")


def abort_button(page: Page, tag: str = TAG) -> Locator:
    return page.get_by_role("button", name=f"Abort {tag}")


def in_stage(page: Page, name: str) -> None:
    expect(under_test(page).locator(STEP)).to_contain_text(name)


def headline(page: Page) -> Locator:
    return page.get_by_role("region", name="Result").get_by_role("heading", level=2).first


def decision(page: Page) -> Locator:
    return page.get_by_role("group", name="Decision")


def number(text: str | None) -> float:
    """The first number of a text with a true minus."""
    found = re.search(r"−?\d+(?:\.\d+)?", text or "")
    assert found is not None, text
    return float(found[0].replace("−", "-"))


def figure(page: Page, row: str) -> tuple[float, float]:
    """Before and after, in the table of a result."""
    cells = page.get_by_role("row", name=row).get_by_role("cell")
    return number(cells.nth(1).text_content()), number(cells.nth(2).text_content())


def remember(page: Page, selector: str) -> None:
    """From now on, each text that is shown there is remembered by the page itself: a short stage is missed by one who
    asks now and then."""
    page.evaluate(
        """(selector) => {
          const seen = (window.seenTexts = []);
          const look = () => {
            const text = document.querySelector(selector)?.textContent;
            if (text && text !== seen.at(-1)) seen.push(text);
          };
          new MutationObserver(look).observe(document.body, { subtree: true, childList: true, characterData: true });
          look();
        }""",
        selector,
    )


def remembered(page: Page) -> list[str]:
    found: list[str] = page.evaluate("window.seenTexts")
    return found
