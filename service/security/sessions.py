"""Sessions of browsers that have signed in with an API key.

A session is in the memory of one service: a restart signs every browser out. Its token (256 random bits) is in the
browser's cookie alone; here it is known by its SHA-256, which is the id of the session.
"""

from __future__ import annotations

import hashlib
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from loopwright.service.security.keys import Scope

LASTS_S = 12 * 3600.0
IDLE_S = 3600.0
OF_KEY = 20
IN_ALL = 1000


@dataclass
class BrowserSession:
    """A session of a browser. Times are monotonic seconds.

    id: SHA-256 of the token.  csrf: what a page of this service sends with a change.
    used_s: the last request, or the last moment of an open stream.  checked_s: when its key was last found valid.
    """

    id: str
    key_id: str
    name: str
    scope: Scope
    csrf: str
    began_s: float
    used_s: float
    checked_s: float


class BrowserSessions:
    """The sessions of one service. `wall` gives monotonic seconds. An object may be used by several threads.

    of_key, in_all: sessions of one key and of all keys; the one that was not used for longest gives way to a new one.
    """

    def __init__(
        self, wall: Callable[[], float] = time.monotonic, *, of_key: int = OF_KEY, in_all: int = IN_ALL
    ) -> None:
        self._wall, self._of_key, self._in_all = wall, of_key, in_all
        self._sessions: OrderedDict[str, BrowserSession] = OrderedDict()  # the one used last is the last
        self._lock = threading.Lock()

    def begin(self, key_id: str, name: str, scope: Scope) -> tuple[str, BrowserSession]:
        """A new session of a key that was found valid in this moment, and its token."""
        token, now = secrets.token_urlsafe(32), self._wall()
        session = BrowserSession(_id_of(token), key_id, name, scope, secrets.token_urlsafe(32), now, now, now)
        with self._lock:
            for each in [each for each in self._sessions.values() if self._over(each, now)]:
                del self._sessions[each.id]
            same = [each.id for each in self._sessions.values() if each.key_id == key_id]
            for old in same[: max(0, len(same) + 1 - self._of_key)]:
                del self._sessions[old]
            while len(self._sessions) >= self._in_all:
                self._sessions.popitem(last=False)
            self._sessions[session.id] = session
        return token, session

    def of(self, token: str) -> BrowserSession | None:
        """The session with this token, which counts as used now; None: there is none, or it is over."""
        return self.use(_id_of(token))

    def use(self, session_id: str) -> BrowserSession | None:
        """The session with this id, which counts as used now; None: there is none, or it is over."""
        now = self._wall()
        with self._lock:
            session = self._sessions.get(session_id)
            if session is None:
                return None
            if self._over(session, now):
                del self._sessions[session_id]
                return None
            session.used_s = now
            self._sessions.move_to_end(session_id)
            return session

    def unchecked_s(self, session: BrowserSession) -> float:
        """Returns the seconds since the session's key was found valid."""
        return self._wall() - session.checked_s

    def checked(self, session: BrowserSession) -> None:
        """The session's key was found valid now."""
        session.checked_s = self._wall()

    def end(self, session_id: str) -> None:
        with self._lock:
            self._sessions.pop(session_id, None)

    def end_of_key(self, key_id: str) -> None:
        """Ends every session of a key."""
        with self._lock:
            for each in [each for each in self._sessions.values() if each.key_id == key_id]:
                del self._sessions[each.id]

    @staticmethod
    def _over(session: BrowserSession, now: float) -> bool:
        return now - session.began_s >= LASTS_S or now - session.used_s >= IDLE_S


def _id_of(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
