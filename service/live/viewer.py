"""What one viewer has not taken yet: the newest of each message that replaces the one before, and the samples."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress

from loopwright.service.listening.bins import Bins
from loopwright.service.live.messages import event
from loopwright.service.live.rows import samples_message

MOST_WAITING = 256 * 1024
"""Characters of samples that wait for a viewer: minutes of several loops. A viewer that lets more wait is dropped."""


class Viewer:
    """An object belongs to one event loop.

    tags: the loops whose samples and events the viewer wants.
    after: numbers of the last events that it has, by job.
    """

    def __init__(self, tags: frozenset[str], after: dict[str, int]) -> None:
        self.tags, self.after = tags, after
        self.slow = False
        self._newest: dict[str, str] = {}
        self._samples: deque[tuple[str, Bins, str]] = deque()
        self._has_until_s: dict[str, float] = {}
        self._waiting = 0
        self._woken = asyncio.Event()

    def show(self, name: str, text: str) -> None:
        """Puts a message in the place of the one of this name that was not taken yet."""
        self._newest[name] = text
        self._woken.set()

    def add_samples(self, tag: str, bins: Bins, text: str) -> None:
        """Adds samples, and their message, which many viewers share."""
        have_s = self._has_until_s.get(tag)
        if have_s is not None:
            new = bins[bins["until_s"] > have_s]
            if not len(new):
                return
            del self._has_until_s[tag]
            if len(new) < len(bins):
                text = event("samples", samples_message(tag, new, past=False))
        self._waiting += len(text)
        if self._waiting > MOST_WAITING:
            self.slow = True
            self._samples.clear()
        else:
            self._samples.append((tag, bins, text))
        self._woken.set()

    def has_until(self, tag: str, last_s: float) -> None:
        """Notes that the viewer has the samples of a loop up to this time: those that overlap are left out."""
        self._has_until_s[tag] = last_s
        waiting, self._samples, self._waiting = self._samples, deque(), 0
        for each_tag, bins, text in waiting:
            self.add_samples(each_tag, bins, text)

    def wake(self) -> None:
        self._woken.set()

    async def woken(self, patience_s: float) -> None:
        """Waits until there is something to take, or for that time."""
        with suppress(TimeoutError):
            async with asyncio.timeout(patience_s):
                await self._woken.wait()
        self._woken.clear()

    def take(self) -> list[str]:
        """Returns what waits."""
        found = [*self._newest.values(), *(text for _, _, text in self._samples)]
        self._newest.clear()
        self._samples.clear()
        self._waiting = 0
        return found
