"""Pages of the browser, each watched: what a page may not do is found whether a test looks for it or not."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request, expect

PATIENCE_MS = 120_000
"""A busy machine is no reason to fail."""
WIDE = {"width": 1440, "height": 900}

expect.set_options(timeout=PATIENCE_MS)

BUSY = r"status of 503"
"""The browser itself writes so of each answer 503. A busy service gives it, and the page asks again."""

# The console has what the policy refuses of scripts, but not of each style and each string that would become markup.
VIOLATIONS = """addEventListener("securitypolicyviolation", (event) =>
  console.error(`Content-Security-Policy: ${event.violatedDirective} refused ${event.blockedURI} ${event.sample}`));"""


@dataclass
class Pages:
    """Opens pages of one service.

    url: of the service.  expected: what their consoles may say, as patterns.  heard: the errors and warnings of their
    consoles.  problems: what else no page may do.
    """

    browser: Browser
    url: str
    problems: list[str] = field(default_factory=list)
    expected: list[str] = field(default_factory=lambda: [BUSY])
    heard: list[str] = field(default_factory=list)
    opened: list[Page] = field(default_factory=list)

    def open(self, path: str = "/ui/", **options: Any) -> Page:
        """A page in a browser of its own: nobody is signed in. options: of Browser.new_context."""
        return self.another(self.context(**options), path)

    def context(self, **options: Any) -> BrowserContext:
        """A browser of its own. options: of Browser.new_context."""
        context = self.browser.new_context(base_url=self.url, **({"viewport": WIDE} | options))
        context.set_default_timeout(PATIENCE_MS)
        context.add_init_script(VIOLATIONS)
        context.on("console", self._said)
        context.on("weberror", lambda error: self.problems.append(f"uncaught: {error.error}"))
        context.on("request", self._asked)
        return context

    def another(self, context: BrowserContext, path: str = "/ui/") -> Page:
        """One more page in that browser."""
        page = context.new_page()
        self.opened.append(page)
        page.goto(path)
        return page

    @contextmanager
    def expecting(self, *patterns: str) -> Iterator[None]:
        """While this lasts, and after it, the console may say what is found by one of the patterns: the browser itself
        writes there whenever an answer is an error or the service is away. It has to say something of each, which may
        be later than what made it do so."""
        before = len(self.heard)
        self.expected += patterns
        yield
        give_up = time.monotonic() + PATIENCE_MS / 1000.0
        for pattern in patterns:
            while not any(re.search(pattern, text) for text in self.heard[before:]):
                assert time.monotonic() < give_up, (pattern, self.heard[before:])
                self.browser.contexts[-1].pages[-1].wait_for_timeout(20.0)

    def unexpected(self) -> list[str]:
        """What a page did that no page may do."""
        said = [text for text in self.heard if not any(re.search(pattern, text) for pattern in self.expected)]
        return self.problems + said

    def forget(self) -> None:
        """What has been found is no more."""
        self.heard.clear()
        self.problems.clear()

    def pictures(self, folder: Path) -> list[Path]:
        """What the pages that are open show now, as files."""
        files = []
        for number, page in enumerate(page for page in self.opened if not page.is_closed()):
            files.append(folder / f"page-{number}.png")
            page.screenshot(path=files[-1], full_page=True)
        return files

    def close(self) -> None:
        for context in list(self.browser.contexts):
            context.close()

    def _said(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.heard.append(f"{message.text} ({message.location.get('url', '')})")

    def _asked(self, request: Request) -> None:
        wanted = urlsplit(request.url)
        if wanted.scheme not in ("data", "blob") and f"{wanted.scheme}://{wanted.netloc}" != self.url:
            self.problems.append(f"asked another origin: {request.url}")
