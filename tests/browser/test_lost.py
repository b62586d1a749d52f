"""What is lost is not shown as if it were there: a service that dies or stands still, and comes back."""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Page, expect

from tests.browser import person, trend
from tests.browser.conftest import PACE
from tests.browser.pages import Pages
from tests.browser.person import DASH
from tests.browser.site import TAG, Site
from tests.e2e.plantsite import STAGES
from tests.unit.service.processes import until

AWAY = r"ERR_CONNECTION_REFUSED|ERR_CONNECTION_RESET|ERR_INCOMPLETE_CHUNKED_ENCODING|ERR_EMPTY_RESPONSE"
SILENT = ".banner[role=alert]"
WITHIN_S = 4.0
COLUMN_S = 2.0
"""More than a column of the trend of 10 minutes, and what its end is behind, s."""


def nothing_is_live(page: Page) -> None:
    """The banner stands, and no number of the process is shown."""
    expect(page.locator(SILENT)).to_contain_text("Service offline for")
    face = person.face(page)
    expect(face.locator(".big")).to_have_text(DASH)
    expect(face.locator(".mid")).to_have_text([re.compile(f"^{DASH}"), re.compile(f"^{DASH}")])
    expect(face.locator(".mode")).to_have_text(DASH)


def all_is_live(page: Page) -> None:
    expect(page.locator(SILENT)).not_to_be_attached()
    expect(person.face(page).locator(".big")).to_have_text(re.compile(r"^\d\d\.\d\d\d$"))


def first_silence_s(page: Page) -> int:
    """The seconds of silence, as the page counted them, that its banner named first."""
    return int(person.number(next(text for text in person.remembered(page) if "Service offline" in text)))


@contextmanager
def frozen(site: Site) -> Iterator[None]:
    """The service stands still."""
    site.service.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        site.service.signal(signal.SIGCONT)


def test_a_service_that_stands_still(site: Site, page: Page) -> None:
    site.finished(site.retune())
    person.open_loop(page)
    accept = page.get_by_role("button", name="Accept the new gains")
    expect(accept).to_be_enabled()
    person.remember(page, SILENT)
    with frozen(site):
        nothing_is_live(page)
        assert first_silence_s(page) < WITHIN_S
        expect(accept).to_be_disabled()
        page.get_by_role("button", name="Retune…").click()
        person.sign(page)
        expect(page.get_by_role("button", name=f"Retune {TAG}")).to_be_disabled()
        expect(page.get_by_role("region", name="Retune")).to_contain_text("The service is offline.")
        page.get_by_role("link", name="Loops", exact=True).click()
        expect(page.get_by_role("row", name=TAG).locator(".pvnum")).to_have_text(DASH)
        expect(page.get_by_role("link", name=re.compile("active alarm"))).to_be_visible()
    expect(page.locator(SILENT)).not_to_be_attached()
    expect(page.get_by_role("row", name=TAG).locator(".pvnum")).to_have_text("50.000")
    person.open_loop(page)
    expect(page.get_by_role("button", name="Accept the new gains")).to_be_enabled()


def test_a_service_that_is_killed_in_mid_test_and_comes_back(site: Site, page: Page, pages: Pages) -> None:
    site.at_rest(0.3 * PACE)
    person.open_loop(page)
    job = site.in_stage(STAGES["fast-relay"])
    person.in_stage(page, "Relay test")
    person.remember(page, SILENT)
    before_s = time.monotonic()
    with pages.expecting(AWAY):
        site.service.kill()
        nothing_is_live(page)
        assert first_silence_s(page) < WITHIN_S
        # Abort is tried all the same, and says that it failed
        person.abort_button(page).click()
        expect(person.dock(page).get_by_role("alert")).to_have_text("Abort failed: The service does not answer.")
        expect(person.abort_button(page)).to_be_enabled()
        site.serve()
        all_is_live(page)
    expect(person.under_test(page)).to_contain_text("Resumed after a restart of the service: the stages begin anew.")
    expect(person.headline(page)).to_have_text("New gains are proposed")
    ended = site.job(job)
    assert (ended["state"], ended["attempts"]) == ("proposed", 2) and site.is_home()
    # two minutes of the plant pass in less than one, and what follows the gap may take longer on a busy machine
    page.get_by_role("button", name="10 min").click()
    expect(page.get_by_role("button", name="10 min")).to_have_attribute("aria-pressed", "true")

    def since() -> list[trend.Gap]:
        """Gaps of this test: those of tests before it are in the window too."""
        longest_ago_s = time.monotonic() - before_s + COLUMN_S
        return [gap for gap in trend.gaps(page, 600.0) if gap.ago_s < longest_ago_s]

    until(lambda: len(since()) == 1, "one gap in the trend")
    assert since()[0].seconds > 2.0
