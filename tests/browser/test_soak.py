"""What a page keeps while the stream goes on, as on a wall of screens for weeks. `make bench` measures an hour."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from benchmarks.hour import STAND_IN, Kept, kept, pass_seconds, session_of
from benchmarks.page_site import live_messages
from tests.browser.pages import Pages
from tests.browser.site import TAG, Site

WARM_S, SECONDS = 30, 120
GROWN_BYTES = 400_000
KEEPS = """JSON.parse = ((parse) => (text) => {
  (globalThis.all ??= []).push(Array(1000).fill(text.length / 3));
  return parse(text);
})(JSON.parse);"""
"""Keeps 8 kB of each message."""
PLACES = {"overview": ("/ui/", "tr.row"), "loop": (f"/ui/loops/{TAG}", ".u-over")}


@pytest.mark.parametrize("place", PLACES)
def test_minutes_of_the_stream_leave_nothing_behind(site: Site, pages: Pages, place: str) -> None:
    before, after = _soaked(site, pages, place)
    assert after.heap - before.heap < GROWN_BYTES, (before, after)
    assert (after.nodes, after.listeners) <= (before.nodes, before.listeners), (before, after)


def test_what_is_kept_of_each_message_is_seen(site: Site, pages: Pages) -> None:
    before, after = _soaked(site, pages, "overview", KEEPS)
    assert after.heap - before.heap > GROWN_BYTES, (before, after)


def _soaked(site: Site, pages: Pages, place: str, script: str = "") -> tuple[Kept, Kept]:
    """What the page keeps after WARM_S of the stream, and after SECONDS more. script: runs before the page's own."""
    path, ready = PLACES[place]
    heard = live_messages(site.url)
    context = pages.context()
    context.add_init_script(f"{STAND_IN}\n{script}")
    page = pages.another(context, path)
    session = session_of(page)
    pass_seconds(page, WARM_S, heard)
    expect(page.locator(ready).first).to_be_visible()
    before = kept(session)
    pass_seconds(page, SECONDS, heard)
    return before, kept(session)
