"""The report of a job as a file: opened without a network, and printed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser import person
from tests.browser.site import TAG, Site


@pytest.fixture
def filed(site: Site, page: Page, tmp_path: Path) -> Path:
    """The report of a fast retune, by its button, saved."""
    assert site.finished(site.retune(by=person.NAME))["state"] == "proposed"
    person.open_loop(page)
    with page.expect_popup() as opened:
        page.get_by_role("link", name="Report").click()
    report = opened.value
    expect(report.get_by_role("heading", level=1, name=TAG)).to_be_visible()
    file = tmp_path / "report.html"
    file.write_bytes(site.http.get(report.url).content)
    return file


@pytest.fixture
def without_network(browser: Browser) -> Iterator[Page]:
    context = browser.new_context(offline=True, viewport={"width": 900, "height": 1200})
    yield context.new_page()
    context.close()


def test_it_is_one_file_of_two_pages(filed: Path, without_network: Page) -> None:
    asked, said = [], []
    without_network.on("request", lambda request: asked.append(request.url))
    without_network.on("console", lambda message: said.append(message.text))
    without_network.goto(filed.as_uri())
    expect(without_network.get_by_text("New gains are proposed").first).to_be_visible()
    for picture in without_network.get_by_role("img").all():
        box = picture.bounding_box()
        assert box is not None and box["width"] > 100 and box["height"] > 40
    printed = without_network.pdf(format="A4", prefer_css_page_size=True)
    assert len(re.findall(rb"/Type\s*/Page\b(?!s)", printed)) == 2
    assert asked == [filed.as_uri()] and said == []
