"""The overview of all loops."""

from __future__ import annotations

import re

from playwright.sync_api import Page, expect

from tests.browser.site import TAG, Site


def test_the_loop_is_live(site: Site, page: Page) -> None:
    row = page.get_by_role("row", name=TAG)
    expect(row.locator(".pvnum")).to_have_text(re.compile(r"^50\.0\d\d$"))
