"""A plant that stops and a bus that dies: words, and the last numbers as old ones."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from playwright.sync_api import Page, expect

from tests.browser import person
from tests.browser.site import TAG, Site

AGE = re.compile(r"^\d.* old$")


@pytest.fixture
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with ExitStack() as stack:
        site = Site(stack, tmp_path_factory.mktemp("site"), more_loops=())
        site.at_rest(1.0)
        yield site


def test_the_plant_stops_and_then_the_hub(site: Site, page: Page) -> None:
    row = page.get_by_role("row", name=TAG)
    expect(row.locator(".pvnum")).to_have_text("50.000")
    expect(page.get_by_text("Nothing abnormal")).to_be_visible()
    site.plant.kill()
    expect(row.locator(".age")).to_have_text(AGE)
    expect(row.locator(".pvnum")).to_have_text("50.000")
    expect(row).to_contain_text("Node 10h is lost")
    expect(page.get_by_role("link", name="1 abnormal")).to_be_visible()
    site.hub.kill()
    expect(row).to_contain_text(f"Bus {site.bus} is down")
    expect(page.get_by_text(f"Bus {site.bus} is down, opening it again every 2 s.")).to_be_visible()
    page.get_by_role("main").get_by_role("link", name=TAG).click()
    expect(person.face(page).locator(".age")).to_have_text(AGE)
    expect(person.face(page)).to_have_class(re.compile(r"\bold\b"))
    expect(page.get_by_role("main")).to_contain_text(f"Bus {site.bus} is down")
    expect(page.get_by_role("region", name="Gains and limits")).not_to_contain_text("80.00")
    start = page.get_by_role("button", name=f"Retune {TAG}")
    person.sign(page)
    expect(start).to_be_disabled()
