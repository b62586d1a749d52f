"""A plant that stops and begins anew: the trend ends, and no line is drawn across what is missing."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from playwright.sync_api import Page, expect

from tests.browser import person, trend
from tests.browser.site import TAG, Site

PATIENCE_S = 60.0


@pytest.fixture
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with ExitStack() as stack:
        site = Site(stack, tmp_path_factory.mktemp("site"), more_loops=())
        site.at_rest(1.0)
        yield site


def until(page: Page, seen: Callable[[], bool]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not seen():
        assert time.monotonic() < give_up, trend.columns(page)
        page.evaluate("new Promise(requestAnimationFrame)")


def empty_at_the_right(page: Page) -> float:
    """The share of the window, 30 s, after the latest PV."""
    found, width = trend.columns(page)
    return (width - found[-1]) / width if found else 1.0


def test_the_plant_is_started_anew(site: Site, page: Page) -> None:
    person.open_loop(page)
    page.keyboard.press("1")
    until(page, lambda: len(trend.columns(page)[0]) > 0 and empty_at_the_right(page) < 0.02)
    site.plant.kill()
    until(page, lambda: empty_at_the_right(page) > 0.12)  # time goes on, and the trend with it
    expect(person.face(page).locator(".age")).to_have_text(re.compile(r"^\d.* old$"))
    assert trend.gaps(page, 30.0) == []
    site.start_plant()
    site.plant.wait_ready()
    expect(person.present(page).locator(".big")).not_to_have_text(person.DASH)
    until(page, lambda: empty_at_the_right(page) < 0.02)
    [gap] = trend.gaps(page, 30.0)
    assert gap.seconds > 3.0
    page.reload()  # the history has the gap, too
    page.keyboard.press("1")
    until(page, lambda: len(trend.gaps(page, 30.0)) == 1)
    assert TAG in page.title()
