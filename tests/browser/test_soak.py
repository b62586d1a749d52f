"""What a page keeps while the stream goes on, as on a wall of screens for weeks. `make bench` measures an hour."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from benchmarks.hour import STAND_IN, kept, pass_seconds, session_of
from benchmarks.page_site import live_messages
from tests.browser.pages import Pages
from tests.browser.site import TAG, Site

WARM_S, SECONDS = 30, 120
GROWN_BYTES = 400_000
PLACES = {"overview": ("/ui/", "tr.row"), "loop": (f"/ui/loops/{TAG}", ".u-over")}


@pytest.mark.parametrize("place", PLACES)
def test_minutes_of_the_stream_leave_nothing_behind(site: Site, pages: Pages, place: str) -> None:
    path, ready = PLACES[place]
    heard = live_messages(site.url)
    context = pages.context()
    context.add_init_script(STAND_IN)
    page = pages.another(context, path)
    session = session_of(page)
    pass_seconds(page, WARM_S, heard)
    expect(page.locator(ready).first).to_be_visible()
    before = kept(session)
    pass_seconds(page, SECONDS, heard)
    after = kept(session)
    assert after.heap - before.heap < GROWN_BYTES, (before, after)
    assert (after.nodes, after.listeners) <= (before.nodes, before.listeners), (before, after)
