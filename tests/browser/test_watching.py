"""What no page may do is found: without these tests, the others would pass on a page that does it."""

from __future__ import annotations

import time

import pytest
from playwright.sync_api import Error, Page

from tests.browser import pages as pages_module
from tests.browser.pages import Pages

MARKUP = "document.body.innerHTML = '<b>of a loop</b>'"
PATIENCE_S = 30.0
WRONG = {
    "console": ("console.error('something is wrong')", "something is wrong"),
    "uncaught": ("setTimeout(() => { throw new Error('nobody catches it'); })", "nobody catches it"),
    "rejected": ("void Promise.reject(new Error('nobody handles it'))", "nobody handles it"),
    "text as markup": (f"try {{ {MARKUP} }} catch {{}}", "Content-Security-Policy: require-trusted-types-for"),
    "picture": ("new Image().src = 'http://127.0.0.2:9/icon.png'", "Content-Security-Policy: img-src"),
    "style": ("document.body.setAttribute('style', 'color: red')", "Content-Security-Policy: style-src"),
    "fetched": ("void fetch('http://127.0.0.2:9/').catch(() => {})", "Content-Security-Policy: connect-src"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_it_is_found(pages: Pages, page: Page, wrong: str) -> None:
    script, found = WRONG[wrong]
    assert pages.unexpected() == []
    page.evaluate(script)
    give_up = time.monotonic() + PATIENCE_S
    while not any(found in text for text in pages.unexpected()):
        assert time.monotonic() < give_up, pages.unexpected()
        page.evaluate("new Promise((done) => setTimeout(done))")  # the browser's events come while it is waited for
    pages.forget()


def test_a_request_to_another_origin_is_found(pages: Pages, page: Page) -> None:
    """That the policy would refuse, were it there: of another host name only the policy of that page counts."""
    with pytest.raises(Error):
        page.goto("http://127.0.0.2:9/")
    assert pages.unexpected() == ["asked another origin: http://127.0.0.2:9/"]
    pages.forget()


def test_what_is_expected_has_to_come(pages: Pages, page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    with pages.expecting("seldom"):
        page.evaluate("console.error('it happens seldom')")
    assert pages.unexpected() == []
    monkeypatch.setattr(pages_module, "PATIENCE_MS", 100.0)
    with pytest.raises(AssertionError), pages.expecting("never"):
        pass
