"""A test that ends without a result, or cannot be started, is understood: reason, numbers, advice, record, the loop."""

from __future__ import annotations

import re

from playwright.sync_api import Page, expect

from loopwright.protocol.profile import Mode
from tests.browser import person
from tests.browser.conftest import PACE
from tests.browser.site import TAG, Site
from tests.e2e.plantsite import STAGES

NOISE = 0.05
"""Of PV: half of the step, where a tenth is permitted."""


def test_a_refused_test(site: Site, page: Page) -> None:
    person.open_loop(page)
    site.write("plant_noise", NOISE)
    person.retune(page)
    expect(person.headline(page)).to_have_text("Refused: noise too high")
    job = site.latest()
    assert (job["state"], job["reason"]) == ("refused", "noise_too_high")
    result = page.get_by_role("region", name="Result")
    said = job["detail"][0].upper() + job["detail"][1:]
    expect(result).to_contain_text(said)
    assert re.search(r"\d", said)
    expect(result.locator(".advice")).to_have_text(job["advice"])
    left = "The loop was left in automatic, set-point 50.000 °C, Kp 80.00, Ti 1.200 s, read back."
    expect(result).to_contain_text(left)
    record = page.get_by_role("region", name="Record")
    expect(record.get_by_role("img", name="PV measured")).to_be_visible()
    expect(record.locator("canvas").first).to_be_visible()
    expect(page.get_by_role("button", name="Accept the new gains")).not_to_be_attached()
    # the overview says it in words, too
    page.get_by_role("link", name="Loops", exact=True).click()
    expect(page.get_by_role("row", name=TAG)).to_contain_text("refused: noise too high")
    site.write("plant_noise", 0.0)


def test_a_loop_in_manual_is_not_tested(site: Site, page: Page) -> None:
    person.open_loop(page)
    site.write("controller_mode_command", Mode.MANUAL)
    form = person.form(page)
    person.sign(page)
    expect(person.face(page)).to_contain_text("MAN")
    expect(form).to_contain_text(
        "The controller is in mode manual, not automatic; to tune it in manual, permit manual in loops.yaml"
    )
    expect(form.locator(".advice")).to_contain_text("automatic")
    start = page.get_by_role("button", name=f"Retune {TAG}")
    expect(start).to_be_disabled()
    site.write("controller_mode_command", Mode.AUTOMATIC)
    expect(start).to_be_enabled()
    expect(form).not_to_contain_text("mode manual")


def test_a_loop_that_is_not_at_rest_for_a_moment_keeps_nobody_from_starting(site: Site, page: Page) -> None:
    """A test looks again for itself; and what the form says of a moment goes when the moment is over."""
    person.open_loop(page)
    site.write("plant_pace", 0.1)  # PV is back within rest after some three seconds of plant time
    site.write("plant_disturbance", 30.0)
    form = person.form(page)
    person.sign(page)
    expect(person.face(page).locator(".big")).to_have_text(re.compile(r"^50\.[1-9]"))
    form.get_by_role("slider").press("ArrowRight")  # asks anew
    expect(form).to_contain_text("off the set-point at this moment")
    expect(page.get_by_role("button", name=f"Retune {TAG}")).to_be_enabled()
    site.write("plant_pace", PACE)
    expect(form).not_to_contain_text("off the set-point at this moment")


def test_another_hand_moves_the_setpoint(site: Site, page: Page) -> None:
    person.open_loop(page)
    site.at_rest(0.5 * PACE)
    job = site.in_stage(STAGES["fast-relay"])
    expect(person.abort_button(page)).to_be_visible()
    site.write("controller_setpoint", 50.03)
    expect(person.headline(page)).to_have_text("Aborted: set-point changed")
    ended = site.job(job)
    assert (ended["state"], ended["reason"]) == ("aborted", "setpoint_changed")
    result = page.get_by_role("region", name="Result")
    expect(result).to_contain_text("50.03")
    expect(result.locator(".advice")).to_have_text(ended["advice"])
    # the other's set-point stays, and the page says so
    left = "The loop was left in automatic, set-point 50.030 °C, Kp 80.00, Ti 1.200 s, read back."
    expect(result).to_contain_text(left)
    expect(person.face(page).locator(".mid").first).to_contain_text("50.030")
    assert site.is_home(sp=50.03)
