"""The page of one gateway shows a loop of another one, decides about it, and says when that gateway does not answer."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from playwright.sync_api import Page, expect

from tests.browser.pages import Pages
from tests.e2e.gatewaysite import CASE, LOOP, OTHER, GatewaySite, database_server

pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GatewaySite]:
    with ExitStack() as stack:
        server = stack.enter_context(database_server())
        yield GatewaySite(stack, tmp_path_factory.mktemp("two"), server)


def test_a_loop_of_another_gateway(site: GatewaySite, pages: Pages) -> None:
    site.proposal()
    # What is computed of the job after its end may take a while, and is asked for again.
    pages.expected.append(r"503 .*/(record|designs)")
    page: Page = pages.open(f"/ui/loops/{LOOP}")
    expect(page.locator(".looptitle")).to_contain_text(f"by way of gateway {OTHER}")
    link = page.locator(".looptitle").get_by_role("link", name=f"gateway {OTHER}")
    expect(link).to_have_attribute("href", f"https://gw-2.example/ui/loops/{LOOP}")
    expect(page.locator(".face .big")).to_have_text("50.000")
    expect(page.locator(".trend")).to_contain_text(f"Samples as they come are at gateway {OTHER}")
    page.get_by_role("button", name="Accept the new gains…").click()
    page.get_by_label("Your name").fill("A. Lind")
    page.get_by_role("button", name=f"Write to {LOOP}").click()
    expect(page.locator(".decide")).to_contain_text("Accepted by A. Lind")
    assert abs(site.kp() - CASE.kp) > 1.0
    page.get_by_role("button", name="Roll back to the previous gains…").click()
    page.get_by_role("button", name=f"Roll {LOOP} back").click()
    expect(page.locator(".decide")).to_contain_text("The loop runs on its previous gains")
    assert site.kp() == pytest.approx(CASE.kp)
    site.other.kill()
    expect(page.locator(".refusal")).to_contain_text(f"no data from gateway {OTHER} for ")
    old = page.locator(".face.old")
    expect(old.locator(".age")).to_have_text(re.compile(r"^\d.* old$"))
    expect(old.locator(".big")).to_have_text("50.000")
    expect(page.locator(".loop-alarm")).to_contain_text(f"Gateway {OTHER} does not answer.")
    expect(page.locator(".refusal")).to_have_count(0)
    # The other abnormal thing is TIC-1 of this gateway, which has no node.
    page.get_by_role("link", name="2 active alarm").click()
    silent = page.get_by_role("row", name=f"gateway {OTHER}")
    expect(silent.get_by_role("link", name=LOOP)).to_be_visible()
    expect(silent.get_by_role("button")).to_have_count(0)
    site.start_other()
    expect(silent).to_have_count(0)
    page.get_by_role("link", name="Loops", exact=True).click()
    expect(page.get_by_role("row", name=LOOP).locator(".pvnum")).to_have_text("50.000")
    expect(page.get_by_role("row", name=LOOP)).not_to_have_class(re.compile(r"\bold\b"))
