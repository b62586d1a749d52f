"""A retune from the form to the decision, as a commissioning engineer does it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from loopwright.protocol.profile import Mode
from tests.browser import person
from tests.browser.person import NAME
from tests.browser.site import TAG, Site

STAGES = ["Steady-state check", "Relay test", "Model and gains", "Set-point step, new gains", "Final model"]


def assert_drawn(page: Page, values: list[float]) -> None:
    """The new curve of the set-point step goes through these values, on a linear axis."""
    path = (
        page.get_by_role("img", name="Set-point step, previous and new gains").locator("path.s-new").get_attribute("d")
    )
    places = np.array([float(y) for y in re.findall(r"[ML][\d.]+ ([\d.]+)", path or "")])
    slope, at_zero = np.polyfit(values, places, 1)
    assert slope < 0.0 and places == pytest.approx(at_zero + slope * np.array(values), abs=0.11)


def test_retuned_compared_accepted_and_rolled_back(site: Site, page: Page) -> None:
    old = site.case
    person.open_loop(page)
    form = person.form(page)
    # the numbers of what will happen are those of loops.yaml
    expect(form).to_contain_text("Then the set-point steps by 0.100\u202f°C under the new gains.")
    expect(form).to_contain_text("It ends by itself if PV leaves 49.000 … 51.000\u202f°C")
    start = page.get_by_role("button", name=f"Retune {TAG}")
    expect(form).to_contain_text("Your name is missing.")
    expect(start).to_be_disabled()
    page.get_by_role("button", name="More options").click()
    form.get_by_label("SP step").fill("x")
    expect(form).to_contain_text("Not a number: “SP step”.")
    form.get_by_label("SP step").fill("5")
    expect(form).to_contain_text("“SP step” 5 is more than the configured 0.1")
    form.get_by_label("SP step").fill("")
    person.sign(page)
    person.remember(page, ".dock .stage")
    start.click()
    expect(person.abort_button(page)).to_be_visible()
    expect(person.headline(page)).to_have_text("New gains are proposed")
    seen = [stage for stage in person.remembered(page) if stage in STAGES]
    assert seen == sorted(seen, key=STAGES.index) and {"Relay test", "Set-point step, new gains"} <= set(seen)

    job = site.latest()
    assert (job["state"], job["by"]) == ("proposed", NAME)
    Kp, Ti = (person.figure(page, name) for name in ("Gain Kp", "Integral time Ti"))
    assert Kp == pytest.approx((old.kp, job["new_gains"]["Kp"]), rel=5e-4)
    assert Ti == pytest.approx((old.ti, job["new_gains"]["Ti"]), rel=5e-4)
    assert person.figure(page, "Largest sensitivity Ms")[1] == pytest.approx(1.6, abs=0.01)

    designs = site.ask(f"{job['url']}/designs")
    assert_drawn(page, designs["new_curves"]["setpoint"]["pv"])

    # a slower loop by the slider: other gains in the table, and no way to accept what was not on the loop
    slider = page.get_by_role("slider", name="Ms", exact=True)
    expect(slider).to_be_enabled()
    slider.press("Shift+ArrowLeft")
    expect(person.decision(page)).to_contain_text("These gains have not been on the loop.")
    expect(page.get_by_role("button", name="Accept the new gains")).not_to_be_attached()
    assert person.figure(page, "Gain Kp")[1] < Kp[1]
    assert person.figure(page, "Largest sensitivity Ms")[1] == pytest.approx(1.55, abs=0.01)
    slower = next(each for each in designs["designs"] if each["Ms_asked"] == 1.55)
    expect(page.locator(".choice")).to_contain_text(slower["beside"])
    assert_drawn(page, slower["curves"]["setpoint"]["pv"])
    slider.press("Escape")
    expect(page.get_by_role("button", name="Accept the new gains")).to_be_enabled()

    page.get_by_role("button", name="Accept the new gains").click()
    asked = person.decision(page)
    expect(asked).to_contain_text(f"into {TAG}, node 20h channel 1, for good.")
    expect(asked.get_by_label("Your name")).to_be_focused()
    assert site.state().gains.Kp == pytest.approx(old.kp)
    page.keyboard.press("Escape")
    expect(asked.get_by_label("Your name")).not_to_be_attached()
    expect(page.get_by_role("button", name="Accept the new gains")).to_be_focused()
    page.keyboard.press("Enter")
    page.get_by_role("button", name=f"Write to {TAG}").click()
    expect(person.headline(page)).to_have_text("Accepted")
    expect(page.locator(".choice")).to_contain_text(designs["new_beside"])
    expect(page.locator(".choice")).not_to_contain_text("present gains")
    expect(person.decision(page)).to_contain_text(f"Accepted by {NAME}; in effect now: Kp {Kp[1]:.2f}")
    gains = site.ask(f"/loops/{TAG}")["live"]["gains"]
    assert (gains["Kp"], gains["Ti"]) == pytest.approx((job["new_gains"]["Kp"], job["new_gains"]["Ti"]))
    assert site.state().gains.Kp == pytest.approx(job["new_gains"]["Kp"])
    expect(page.get_by_role("region", name="Gains and limits")).to_contain_text(f"{Kp[1]:.2f}")

    page.get_by_role("button", name="Roll back to the previous gains").click()
    expect(person.decision(page)).to_contain_text("Write the previous gains, Kp 80.00 %/°C, Ti 1.200 s, back")
    page.get_by_role("button", name=f"Roll {TAG} back").click()
    expect(person.headline(page)).to_have_text("Rolled back to the previous gains")
    assert site.is_home() and site.job(job["url"])["state"] == "rolled_back"


def test_another_Ms_is_tried_on_the_loop_before_it_can_be_accepted(site: Site, page: Page) -> None:
    first = site.finished(site.retune())
    assert first["state"] == "proposed"
    person.open_loop(page)
    slider = page.get_by_role("slider", name="Ms", exact=True)
    expect(slider).to_be_enabled()
    for _ in range(4):
        slider.press("Shift+ArrowLeft")
    page.get_by_role("button", name=f"Try Ms 1.40 on {TAG}…").click()
    expect(person.decision(page)).to_contain_text("steps the set-point by 0.100\u202f°C under the gains for Ms 1.40")
    person.sign(page)
    page.get_by_role("button", name=f"Try Ms 1.40 on {TAG}").click()
    expect(person.under_test(page)).to_be_visible()
    expect(person.under_test(page).get_by_role("listitem")).not_to_contain_text(["Relay test"])
    expect(person.headline(page)).to_have_text("New gains are proposed")
    expect(page.get_by_role("region", name="Result")).to_contain_text("Ms 1.40 on the model")
    second = site.latest()
    assert second["url"] != first["url"] and (second["state"], second["by"]) == ("proposed", NAME)
    assert second["predicted"]["Ms"] == pytest.approx(1.4, abs=0.01) and second["step_after"]["settled"]
    assert second["new_gains"]["Kp"] < first["new_gains"]["Kp"] and site.is_home()
    expect(page.get_by_role("button", name="Accept the new gains")).to_be_enabled()
    # the first proposal is no longer to be decided
    page.goto(f"/ui{first['url']}")
    expect(person.headline(page)).to_have_text("Proposed, not decided; a later job came")
    expect(page.get_by_role("button", name="Accept the new gains")).not_to_be_attached()


def test_gains_are_not_offered_for_a_trial_in_manual(site: Site, page: Page) -> None:
    assert site.finished(site.retune())["state"] == "proposed"
    person.open_loop(page)
    slider = page.get_by_role("slider", name="Ms", exact=True)
    expect(slider).to_be_enabled()
    for _ in range(4):
        slider.press("Shift+ArrowLeft")
    offered = page.get_by_role("button", name=f"Try Ms 1.40 on {TAG}")
    offered.click()
    expect(page.get_by_label("Your name")).to_be_visible()
    site.write("controller_mode_command", Mode.MANUAL)
    expect(person.decision(page)).to_contain_text(
        "cannot be tried: a trial steps the set-point, and the loop is in manual"
    )
    expect(offered).not_to_be_attached()
    expect(page.get_by_label("Your name")).not_to_be_attached()
    page.get_by_role("button", name="Back to Ms 1.60").click()
    expect(page.get_by_role("button", name="Accept the new gains")).to_be_enabled()
    slider.press("Shift+ArrowLeft")
    expect(person.decision(page)).to_contain_text("Put it in automatic to try them.")
    site.write("controller_mode_command", Mode.AUTOMATIC)
    expect(page.get_by_role("button", name=f"Try Ms 1.55 on {TAG}…")).to_be_enabled()
