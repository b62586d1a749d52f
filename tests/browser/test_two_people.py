"""Two people at one loop, each in a browser of their own."""

from __future__ import annotations

import time

import pytest
from playwright.sync_api import Page, Route, expect

from loopwright.protocol.profile import ParameterCommand
from tests.browser import person
from tests.browser.conftest import PACE
from tests.browser.pages import Pages
from tests.browser.site import TAG, Site

LOOP = f"/ui/loops/{TAG}"
OTHER = "B. Roth"


def proposed(site: Site) -> None:
    assert site.finished(site.retune(by=person.NAME))["state"] == "proposed"


def test_the_test_of_one_is_seen_by_the_other(site: Site, pages: Pages, page: Page) -> None:
    other = pages.open(LOOP)
    person.form(other)
    site.write("plant_pace", 1.0)
    person.open_loop(page)
    person.retune(page)
    expect(person.under_test(other)).to_contain_text(f"Asked for by {person.NAME}")
    expect(other.get_by_role("region", name="Retune")).to_have_count(0)
    person.in_stage(other, "Relay test")
    person.abort_button(other).click()
    for each in (page, other):
        expect(person.headline(each)).to_contain_text("Aborted: by an operator")
    assert site.is_home()


def test_no_other_test_than_the_one_that_has_ended_is_shown(site: Site, pages: Pages, page: Page) -> None:
    """Neither the result of the one before it, nor the record of one that ended before it had any."""
    without_record(site)
    person.open_loop(page)
    expect(person.headline(page)).to_contain_text("Aborted: by an operator")
    expect(page.get_by_role("region", name="Record")).to_have_count(0)
    proposed(site)
    expect(person.headline(page)).to_have_text("New gains are proposed")
    site.write("plant_pace", 1.0)
    url = site.retune()
    person.in_stage(page, "Relay test")
    person.remember(page, "section[aria-label=Result] h2")
    site.http.post(f"{url}/abort")
    expect(person.headline(page)).to_contain_text("Aborted: by an operator")
    assert len(person.remembered(page)) == 1


def without_record(site: Site) -> None:
    """A test of one sample: the abort comes while the next one is waited for, which takes a second."""
    site.write("plant_pace", 0.05)
    for _ in range(20):
        url = site.retune()
        site.until(url, lambda job: job["stage"] == "preflight")
        time.sleep(0.5)  # a sample comes each second: every other time the first one is there, and never the second
        site.http.post(f"{url}/abort")
        job = site.finished(url)
        if len(site.ask(f"{url}/samples")["t_s"]) == 1:
            assert job["plant_time_s"] > 0.0 and job["record"] == "none"
            site.write("plant_pace", PACE)
            return
    raise AssertionError("each of 20 tests had another sample before its end")


def test_who_asks_too_late_is_shown_the_test_of_the_other(site: Site, pages: Pages) -> None:
    page = pages.open(LOOP)
    person.form(page)
    person.sign(page, OTHER)
    started = []

    def overtaken(route: Route) -> None:
        """The other one's request arrives first."""
        site.write("plant_pace", 1.0)
        started.append(site.retune(by=person.NAME))
        route.continue_()

    page.route("**/retune", overtaken)
    with pages.expecting("status of 409"):
        page.get_by_role("button", name=f"Retune {TAG}").click()
        expect(person.under_test(page)).to_contain_text(f"Asked for by {person.NAME}")
    expect(page.get_by_role("region", name="Retune")).to_have_count(0)
    [url] = started
    person.in_stage(page, "Relay test")
    site.http.post(f"{url}/abort")
    site.finished(url)


def test_what_one_accepts_the_other_sees(site: Site, pages: Pages, page: Page) -> None:
    other = pages.open(LOOP)
    proposed(site)
    person.open_loop(page)
    for each in (page, other):
        expect(person.headline(each)).to_have_text("New gains are proposed")
    page.get_by_role("button", name="Accept the new gains…").click()
    person.sign(page)
    page.get_by_role("button", name=f"Write to {TAG}").click()
    expect(person.headline(other)).to_have_text("Accepted")
    expect(person.decision(other)).to_contain_text(f"Accepted by {person.NAME}")
    other.get_by_role("button", name="Roll back to the previous gains…").click()
    person.sign(other, OTHER)
    other.get_by_role("button", name=f"Roll {TAG} back").click()
    expect(person.headline(page)).to_have_text("Rolled back to the previous gains")
    assert site.is_home()


def test_gains_that_somebody_else_has_changed_are_not_overwritten(site: Site, pages: Pages, page: Page) -> None:
    proposed(site)
    person.open_loop(page)
    page.get_by_role("button", name="Accept the new gains…").click()
    person.sign(page)
    try:
        change_gain(site, 75.0)
        with pages.expecting("status of 409"):
            page.get_by_role("button", name=f"Write to {TAG}").click()
            expect(person.decision(page).get_by_role("alert")).to_contain_text("75")
        assert site.state().gains.Kp == pytest.approx(75.0)
    finally:
        change_gain(site, site.case.kp)


def change_gain(site: Site, kp: float) -> None:
    """By hand, at the controller."""
    site.write("controller_staged_kp", kp)
    site.write("controller_staged_ti", site.case.ti)
    site.write("controller_parameter_command", ParameterCommand.TRY)
    site.write("controller_parameter_command", ParameterCommand.ACCEPT)
