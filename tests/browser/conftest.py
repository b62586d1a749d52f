"""A browser, a service with its loop, and pages that fail the test in which they do what no page may do.

A file whose tests end more than the service, or need another one, has a fixture `site` of its own.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from tests.browser import CHROMIUM
from tests.browser.pages import Pages
from tests.browser.site import Site

OPTIONS = (
    "--no-sandbox",  # it does not work for root, who runs the tests in containers
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
PACE = 10.0
"""Of the plant, in plant time for real time: a fast retune takes some three seconds."""

_FAILED = pytest.StashKey[bool]()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if isinstance(item, pytest.Function) and "browser" in item.fixturenames and "tests/browser" in str(item.path):
            item.add_marker("browser")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    report: pytest.TestReport = yield
    item.stash[_FAILED] = item.stash.get(_FAILED, False) or report.failed
    return report


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Debian's Chromium."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which(CHROMIUM), args=OPTIONS)
        yield browser
        browser.close()


@pytest.fixture(scope="package")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """The processes that the tests of this folder share."""
    with ExitStack() as stack:
        yield Site(stack, tmp_path_factory.mktemp("site"))


@pytest.fixture
def site(processes: Site) -> Iterator[Site]:
    """The shared processes, the loop at rest on its previous gains, the plant at PACE."""
    processes.at_rest(PACE)
    yield processes
    processes.left_alone()


@pytest.fixture
def pages(request: pytest.FixtureRequest, site: Site, browser: Browser, tmp_path: Path) -> Iterator[Pages]:
    """Pages of the service of `site`."""
    pages = Pages(browser, site.url)
    yield pages
    failed = request.node.stash.get(_FAILED, False)
    unexpected = pages.unexpected()
    if failed or unexpected:
        print("the pages as they were:", *pages.pictures(tmp_path))
    pages.close()
    assert not unexpected, "\n".join(unexpected)


@pytest.fixture
def page(pages: Pages) -> Page:
    """A page that shows the loops."""
    return pages.open()
