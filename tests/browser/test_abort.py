"""Abort: one press, in any stage, by the button or by the keys; the loop is back, and a second press harms nothing."""

from __future__ import annotations

import pytest
from playwright.sync_api import Page, expect

from loopwright.protocol.profile import Mode
from tests.browser import person
from tests.browser.conftest import PACE
from tests.browser.site import Site
from tests.e2e.plantsite import STAGES

ANSWERED_MS = 500
PRESS = """(button) => new Promise((done) => {
  const began = performance.now();
  new MutationObserver((_, observer) => {
    if (!button.textContent.startsWith("Aborting")) return;
    observer.disconnect();
    requestAnimationFrame(() => done(performance.now() - began));
  }).observe(button, { subtree: true, childList: true, characterData: true });
  button.click();
})"""


def aborts_of(page: Page) -> list[str]:
    """The aborts that this page sends from now on."""
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if request.url.endswith("/abort") else None)
    return sent


def is_back(site: Site, page: Page, job: str) -> None:
    """The loop, on the page and in its controller."""
    expect(person.headline(page)).to_have_text("Aborted: by an operator")
    expect(person.dock(page)).not_to_be_attached()
    expect(person.face(page)).to_contain_text("AUTO")
    expect(person.face(page).locator(".mid").first).to_contain_text("50.000")
    ended = site.job(job)
    assert (ended["state"], ended["reason"]) == ("aborted", "operator")
    state = site.state()
    assert (state.mode, state.on_trial, state.sp) == (Mode.AUTOMATIC, False, site.case.sp)
    assert site.is_home()


@pytest.mark.parametrize("stage", ["fast-relay", "fast-verify", "ultimate", "setpoint-pulses"])
def test_by_the_button_in_mid_test(site: Site, page: Page, stage: str) -> None:
    where = STAGES[stage]
    site.at_rest(0.5 * PACE * where.pace)
    person.open_loop(page)
    sent = aborts_of(page)
    job = site.in_stage(where)
    button = person.abort_button(page)
    expect(button).to_be_enabled()
    assert button.evaluate(PRESS) < ANSWERED_MS
    page.keyboard.press("Control+.")  # again
    is_back(site, page, job)
    assert len(sent) == 1


def test_by_the_keys_from_another_view(site: Site, page: Page) -> None:
    page.goto("/ui/jobs")
    sent = aborts_of(page)
    job = site.in_stage(STAGES["fast-relay"])
    expect(person.abort_button(page)).to_be_visible()
    page.keyboard.press("Control+.")
    page.keyboard.press("Control+.")
    expect(person.dock(page)).not_to_be_attached()
    assert len(sent) == 1
    page.goto("/ui/")
    person.open_loop(page)
    is_back(site, page, job)
