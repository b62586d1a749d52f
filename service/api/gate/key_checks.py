"""Checks of API keys: a key in use passes without waiting, unknown keys are hashed one at a time.

The hash of a key takes some 50 ms and 16 MiB, so an unknown key counts as a guess until it is found valid: the attempt
is counted by address and by key id before anything is hashed. One key of an address is checked at a time, so a client
waits behind one guess of each other address, not behind all guesses.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import TypeVar

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.api.gate.limits import Buckets, RequestLimits
from loopwright.service.security.keys import key_id_of
from loopwright.service.store.keyring import Keyring
from loopwright.service.store.tables import KeyRow

T = TypeVar("T")
log = logging.getLogger(__name__)

_ABORT_WAITS_S = 1.0
"""Wall time for which an abort waits for the look at a key that was valid before."""


class TooOften(Exception):
    """Too many requests or wrong keys; the text says of whom. wait_s: seconds until the next one is permitted."""

    def __init__(self, why: str, wait_s: float) -> None:
        super().__init__(why)
        self.wait_s = wait_s


class KeyChecks:
    """Checks keys in threads of its own, which the routes cannot block. An object belongs to one event loop."""

    def __init__(self, keyring: Keyring, limits: RequestLimits, wall: Callable[[], float] = time.monotonic) -> None:
        self._keyring = keyring
        self._by_address = Buckets(limits.bad_keys_per_s, limits.bad_keys_burst, wall)
        self._by_key = Buckets(limits.bad_keys_per_s, limits.bad_keys_burst, wall)
        self._turns: dict[str, asyncio.Lock] = {}
        self._waiting: Counter[str] = Counter()
        self._hashing = ThreadPoolExecutor(1, "key hash")
        self._looking = ThreadPoolExecutor(2, "key")

    async def row(self, key: str, address: str, stops_a_test: bool = False) -> KeyRow | None:
        """The row of a valid key, None for a wrong key. Raises TooOften, SQLAlchemyError."""
        found = self._keyring.known(key)
        if found is not None:
            return found
        if self._keyring.was_right(key):
            last = self._keyring.last_valid(key_id_of(key) or "") if stops_a_test else None
            return await _unless_away(self._in(self._looking, key), last)
        self._refuse_early(address)
        async with self._turn(address):
            return self._keyring.known(key) or await self._guess(key, address)

    async def still_valid(self, key_id: str, stops_a_test: bool = False) -> bool:
        """Whether a key that was checked before is valid now. Raises SQLAlchemyError."""
        last = stops_a_test and self._keyring.last_valid(key_id) is not None
        return await _unless_away(self._look(lambda: self._keyring.still_valid(key_id)), last or None)

    async def name_of(self, key: str) -> str | None:
        """The name of the key that has the id of this one; None: there is none. Raises SQLAlchemyError."""
        key_id = key_id_of(key)
        return None if key_id is None else await self._look(lambda: self._keyring.name_of(key_id))

    async def _guess(self, key: str, address: str) -> KeyRow | None:
        # Many guesses at a key id do not refuse an address without wrong guesses of late: it may be the key's owner.
        clean = self._by_address.full(address)
        self._refuse_early(address)
        self._by_address.take(address)
        key_id = key_id_of(key)
        if key_id is None:
            return None
        if (wait := self._by_key.take(key_id)) and not clean:
            raise TooOften(f"too many wrong keys with the id {key_id}", wait)
        try:
            found = await self._in(self._hashing, key)
        except SQLAlchemyError:
            self._by_address.give_back(address)
            raise
        if found is not None:
            self._by_address.give_back(address)
            self._by_key.give_back(key_id)
        return found

    def _refuse_early(self, address: str) -> None:
        if wait := self._by_address.wait_s(address):
            raise TooOften("too many wrong keys from this address", wait)

    @asynccontextmanager
    async def _turn(self, address: str) -> AsyncIterator[None]:
        turn = self._turns.setdefault(address, asyncio.Lock())
        self._waiting[address] += 1
        try:
            async with turn:
                yield
        finally:
            self._waiting[address] -= 1
            if not self._waiting[address]:
                del self._waiting[address], self._turns[address]

    async def _look(self, look: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._looking, look)

    async def _in(self, threads: ThreadPoolExecutor, key: str) -> KeyRow | None:
        return await asyncio.get_running_loop().run_in_executor(threads, self._keyring.check, key)


async def _unless_away(looked_up: Awaitable[T], last: T | None) -> T:
    """What the database says of a key. last: what it said last, where that is enough while it does not answer."""
    if last is None:
        return await looked_up
    try:
        return await asyncio.wait_for(looked_up, _ABORT_WAITS_S)
    except (TimeoutError, SQLAlchemyError) as error:
        log.warning("the keys cannot be read, an abort is let in by a key that was valid: %s", error or "no answer yet")
        return last
