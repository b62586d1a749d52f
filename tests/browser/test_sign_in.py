"""Signing in with a key, what each scope may do, and the end of a session."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from loopwright.service.security.keys import Scope
from loopwright.service.store.database import migrate, open_database
from loopwright.service.store.keyring import Keyring
from tests.browser import person
from tests.browser.pages import Pages
from tests.browser.site import ABSENT, TAG, Site

REFUSED = r"status of 401"
"""The browser itself writes so of each answer 401."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("site")


@pytest.fixture(scope="module")
def keyring(folder: Path) -> Iterator[Keyring]:
    """As `loopwright key` uses it, beside the service, which begins with one key that nobody here has."""
    data = folder / "data"
    data.mkdir(mode=0o700)
    engine = open_database(data, None, "test")
    migrate(engine)
    keyring = Keyring(engine)
    keyring.create("administrator", Scope.ADMIN)
    yield keyring
    engine.dispose()


@pytest.fixture(scope="module")
def processes(folder: Path, keyring: Keyring) -> Iterator[Site]:
    with ExitStack() as stack:
        site = Site(stack, folder, served_with=("--auth",))
        site.at_rest(1.0)
        yield site


@pytest.fixture
def site(processes: Site) -> Site:
    return processes


@pytest.fixture
def page(pages: Pages) -> Page:
    """A page on which nobody is signed in."""
    with pages.expecting(REFUSED):
        page = pages.open(f"/ui/loops/{TAG}")
        expect(page.get_by_label("API key")).to_be_focused()
    return page


def sign_in(page: Page, key: str) -> None:
    page.get_by_label("API key").fill(key)
    page.keyboard.press("Enter")


def test_a_wrong_key(page: Page) -> None:
    sign_in(page, "lw_nobody_has_this_key")
    expect(page.get_by_role("alert")).to_have_text("This key is not known, was revoked or has expired.")
    expect(page.get_by_label("API key")).to_be_editable()
    expect(page.get_by_role("button", name="Sign in")).to_be_enabled()


def test_a_key_that_may_read_has_no_button_that_changes_something(
    pages: Pages, page: Page, keyring: Keyring, site: Site
) -> None:
    sign_in(page, keyring.create("wall screen", Scope.READ)[1])
    expect(person.face(page).locator(".big")).to_have_text("50.000")  # where one wanted to go
    expect(page.get_by_text("Your key may read. To retune it needs the scope operate.")).to_be_visible()
    main = page.get_by_role("main")
    expect(page.get_by_role("region", name="Process model")).to_be_visible()
    for name in ("Retune", "Accept", "Abort", "Keep the old", "Roll back"):
        expect(page.get_by_role("button", name=name)).not_to_be_attached()
    expect(page.get_by_role("link", name="Log")).not_to_be_attached()
    expect(page.get_by_role("banner")).to_contain_text("wall screen · read")

    # a test that somebody else has begun is seen, and cannot be ended by this key
    _, operate = keyring.create("console", Scope.OPERATE)
    answer = site.http.post(f"/loops/{TAG}/retune", json={}, headers={"Authorization": f"Bearer {operate}"})
    assert answer.status_code == 202
    expect(person.under_test(page)).to_be_visible()
    expect(person.dock(page)).to_contain_text(TAG)
    expect(person.abort_button(page)).not_to_be_attached()
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.method))
    page.keyboard.press("Control+.")
    with page.expect_request("**/batches*"):
        page.get_by_role("link", name="Batches").click()
    expect(main.get_by_role("heading", name="Batches")).to_be_visible()
    expect(main.get_by_role("button")).to_have_count(0)
    assert set(sent) == {"GET"}
    with_key = {"Authorization": f"Bearer {operate}"}
    assert site.http.post(f"{answer.headers['location']}/abort", headers=with_key).status_code == 202
    expect(person.dock(page)).not_to_be_attached()


def test_a_key_that_may_operate_and_the_way_out(pages: Pages, page: Page, keyring: Keyring) -> None:
    sign_in(page, keyring.create("control room", Scope.OPERATE)[1])
    person.form(page)
    person.sign(page)
    expect(page.get_by_role("button", name=f"Retune {TAG}")).to_be_enabled()
    expect(page.get_by_role("link", name="Log")).not_to_be_attached()
    second = pages.another(page.context, f"/ui/loops/{ABSENT['tag']}")
    expect(second.get_by_role("heading", name=ABSENT["tag"])).to_be_visible()
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_role("heading", name="Sign in to Loopwright")).to_be_visible()
    # the other page of this browser notices, and nothing of the loop is left on either
    with pages.expecting(REFUSED):
        expect(second.get_by_role("heading", name="Sign in to Loopwright")).to_be_visible()
        page.reload()
        expect(page.get_by_label("API key")).to_be_focused()
    for each in (page, second):
        expect(each.get_by_text(TAG)).not_to_be_attached()
    assert [cookie["name"] for cookie in page.context.cookies()] == []


def test_a_key_that_is_revoked_meanwhile(pages: Pages, page: Page, keyring: Keyring) -> None:
    row, key = keyring.create("contractor", Scope.OPERATE)
    sign_in(page, key)
    expect(person.face(page).locator(".big")).to_have_text("50.000")
    with pages.expecting(REFUSED):
        keyring.revoke(row.id)
        expect(page.get_by_role("heading", name="Sign in to Loopwright")).to_be_visible()
    expect(page.get_by_role("status")).to_contain_text("its key was revoked. Tests that run go on.")
    _, another = keyring.create("contractor 2", Scope.OPERATE)
    sign_in(page, another)
    expect(page.get_by_role("heading", name=TAG)).to_be_visible()
