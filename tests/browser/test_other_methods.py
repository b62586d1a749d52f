"""Jobs of the other methods show their stages and their results."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from tests.browser import person
from tests.browser.pages import Pages
from tests.browser.site import Site

FIVE_STAGE = [
    "Steady-state check", "Set-point step, previous gains", "Relay test", "Ultimate gain", "Ziegler-Nichols PI",
    "FOPDT estimate", "Optimisation", "Set-point step, new gains",
]  # fmt: skip


@pytest.mark.parametrize("method", ["five-stage", "zn-ultimate"])
def test_its_stages_and_its_result(site: Site, pages: Pages, method: str) -> None:
    site.write("plant_pace", 0.0)  # it takes minutes of plant time
    job = site.finished(site.retune(method=method))
    assert job["state"] == "proposed", job
    page = pages.open(f"/ui{job['url']}")
    expect(person.headline(page)).to_have_text("New gains are proposed")
    stages = page.locator(".stages li b")
    expect(stages.first).to_have_text("✓ Steady-state check")
    names = [name.removeprefix("✓ ") for name in stages.all_text_contents()]
    if method == "five-stage":
        assert names == FIVE_STAGE
    else:
        assert names[-1] == "Set-point step, new gains" and "Ultimate gain" in names
    before, after = person.figure(page, "Gain Kp")
    assert before == pytest.approx(job["previous_gains"]["Kp"], rel=1e-3)
    assert after == pytest.approx(job["new_gains"]["Kp"], rel=1e-3)
    expect(page.get_by_role("img", name="PV measured, set-point and model")).to_be_visible()
