"""Markup in descriptions, notes and signatures is shown as the text that it is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from playwright.sync_api import Page, expect

from tests.browser import person
from tests.browser.conftest import PACE
from tests.browser.pages import Pages
from tests.browser.site import LOOP, TAG, Site

HOSTILE = "<img src=x onerror=\"document.title='taken'\"><script>document.title='taken'</script>"


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A service in whose loops.yaml somebody has written markup."""
    changes = {**LOOP, "description": HOSTILE, "notes": HOSTILE}
    with ExitStack() as stack:
        yield Site(stack, tmp_path_factory.mktemp("site"), changes=changes)


def shown(page: Page) -> None:
    expect(page.get_by_text(HOSTILE).first).to_be_visible()
    assert page.locator("img, main script").count() == 0 and page.title() != "taken"


def test_it_is_text_everywhere(site: Site, pages: Pages, page: Page) -> None:
    assert site.case.kp and PACE
    shown(page)
    person.open_loop(page)
    shown(page)
    person.form(page)
    person.sign(page, HOSTILE)
    page.get_by_role("button", name=f"Retune {TAG}").click()
    expect(page.get_by_text(f"Asked for by {HOSTILE}")).to_be_visible()
    expect(person.headline(page)).to_have_text("New gains are proposed")
    shown(page)
    page.get_by_role("button", name="Keep the previous gains…").click()
    person.decision(page).get_by_role("button", name="Keep the previous gains").click()
    expect(person.decision(page)).to_contain_text(f"decided by {HOSTILE}")
    for path in ("/jobs", "/log"):
        page.goto(f"/ui{path}")
        shown(page)
    page.goto(f"{site.latest()['url']}/report")
    shown(page)
