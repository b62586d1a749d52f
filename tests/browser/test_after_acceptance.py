"""A second path that the test could not show is found in operation, and rolled back, on the page.

The loop, its controller and the clock are simulated; the API behind the page is the real one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from loopwright.plantsim.catalogue import LaterPath
from tests.browser import person
from tests.browser.person import NAME
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import NEW, OLD, TAG, Service
from tests.unit.service.jobs.watched import PU, WatchedLoop
from tests.unit.service.served import served


@dataclass
class SimulatedSite:
    """A service with a proposal, and its address."""

    url: str
    loop: WatchedLoop


@pytest.fixture
def site(tmp_path: Path) -> Iterator[SimulatedSite]:
    service = Service(tmp_path)
    loop = WatchedLoop(service, second_path=LaterPath(0.43, 4.0 * PU))
    with served(app_of(service.jobs)) as server:
        yield SimulatedSite(f"http://127.0.0.1:{server.port}", loop)
    service.close()


def test_a_second_path_is_found_in_operation_and_rolled_back(site: SimulatedSite, page: Page) -> None:
    loop = site.loop
    page.goto(f"/ui/jobs/{loop.job_id}")
    page.get_by_role("button", name="Accept the new gains").click()
    itself = page.get_by_role("checkbox", name="Put the previous gains back automatically")
    expect(itself).to_be_checked()
    person.sign(page)
    page.get_by_role("button", name=f"Write to {TAG}").click()
    expect(person.headline(page)).to_have_text("Accepted")
    watch = page.get_by_role("region", name="Monitoring after acceptance")
    expect(watch).to_contain_text("Nothing has moved the loop yet since the gains were accepted.")
    expect(watch).to_contain_text("The previous gains are put back automatically if PV leaves its limits")
    assert loop.watch.auto_rollback and loop.watch.by == NAME and loop.service.controller.state.gains == NEW

    loop.goes_on(2.0)
    for size in (1.0, -1.0, 1.5):
        loop.goes_on(13.0, size)
    expect(watch.get_by_role("status")).to_contain_text("The plant is not the one of the model: a second path acts")
    expect(watch.get_by_role("row")).to_have_count(1 + 3)
    expect(watch).to_contain_text("What fits instead: a second path acts 13.3 s later, with 43 ±")
    page.goto(f"/ui/loops/{TAG}")
    expect(page.get_by_text("The plant is not the one of the model").first).to_be_visible()
    expect(page.get_by_text("Roll the new gains back, or retune the loop.").first).to_be_visible()

    page.get_by_role("button", name="Roll back to the previous gains").click()
    person.sign(page)
    page.get_by_role("button", name=f"Roll {TAG} back").click()
    expect(person.headline(page)).to_have_text("Rolled back to the previous gains")
    expect(page.get_by_role("region", name="Result").first).to_contain_text(f"previous gains put back by {NAME}")
    assert loop.service.controller.state.gains == OLD


def test_that_the_old_gains_come_back_by_itself_can_be_declined(site: SimulatedSite, page: Page) -> None:
    page.goto(f"/ui/jobs/{site.loop.job_id}")
    page.get_by_role("button", name="Accept the new gains").click()
    page.get_by_role("checkbox", name="Put the previous gains back automatically").uncheck()
    person.sign(page)
    page.get_by_role("button", name=f"Write to {TAG}").click()
    watch = page.get_by_role("region", name="Monitoring after acceptance")
    expect(watch).to_contain_text("The previous gains are not put back automatically.")
    assert not site.loop.watch.auto_rollback
