"""What this gateway says of itself, and the thread that writes it into the shared database once a second."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable
from importlib.metadata import version

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.jobs.active_job import Running
from loopwright.service.jobs.journal import temporary
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.listening import Listening
from loopwright.service.live.messages import BusView, LoopValues
from loopwright.service.live.rows import LiveFacts, loop_values
from loopwright.service.live.snapshot import SETTINGS, LoopSettings, Present, progress_of
from loopwright.service.store import gateways
from loopwright.service.store.lock import FolderInUse

log = logging.getLogger(__name__)

WRITE_S = 1.0
"""Wall time between two rows, s."""
_SETTINGS_AGAIN_S = 60.0
"""Wall time after which the settings are written although they have not changed, s: the row may have been restored from
a back-up meanwhile."""
_STOP_S = 2.0


class OwnGateway:
    """What this gateway says of itself.

    url: where browsers reach it, as configured.  alarms: what is abnormal; None: nothing is said of that.
    """

    def __init__(
        self, jobs: Jobs, listening: Listening, url: str | None = None, alarms: AlarmWatch | None = None
    ) -> None:
        self._jobs, self._listening, self._alarms = jobs, listening, alarms
        self.url = url
        self.name = jobs.store.host
        self.version = version("loopwright")

    def present(self, now_s: float) -> Present:
        """Returns the present state of its loops, buses, jobs and alarms. now_s: s since 1970 UTC."""
        running = list(self._jobs.registry.running.copy().values())
        loops = [self._values(tag, running, now_s) for tag in self._jobs.directory.loops]
        alarms = [] if self._alarms is None else self._alarms.only_known_here()
        progress = [progress_of(each) for each in running]
        return Present(loops=loops, buses=self.buses(), jobs=progress, alarms=alarms)

    def values(self, tag: str, now_s: float) -> LoopValues:
        """Returns what was heard last of one of its loops. now_s: s since 1970 UTC."""
        return self._values(tag, self._jobs.registry.running.copy().values(), now_s)

    def _values(self, tag: str, running: Iterable[Running], now_s: float) -> LoopValues:
        held = next((each.loop.latest for each in running if each.tag == tag and each.loop is not None), None)
        known = LiveFacts(self._listening.heard.get(tag), self._listening.why_not_heard(tag), held)
        return loop_values(tag, known, now_s)

    def buses(self) -> list[BusView]:
        """Returns its buses as they are."""
        off, begun = self._listening.off, self._listening.begun
        return [
            BusView(gateway=self.name, bus=url, up=why is None if begun and url not in off else None, why=why)
            for url, why in self._listening.buses().items()
        ]

    def settings(self) -> dict[str, LoopSettings]:
        """Returns what the controllers were read as last, by tag."""
        return {tag: LoopSettings.of(state) for tag, state in self._jobs.directory.last_read.copy().items()}


class Announcing:
    """Writes the row of this gateway once a second, in a thread of its own, where gateways share a database. While the
    database is away nothing else waits for it, and it is tried on."""

    def __init__(self, jobs: Jobs, own: OwnGateway) -> None:
        self._store, self._own = jobs.store, own
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="row of this gateway", daemon=True)
        self._settings, self._settings_at = b"", -_SETTINGS_AGAIN_S
        self._failed = False

    def start(self) -> None:
        if self._store.shared:
            self._thread.start()

    def close(self) -> None:
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join(_STOP_S)

    def write(self) -> None:
        """Writes the row. Raises SQLAlchemyError, FolderInUse."""
        present = self._own.present(time.time()).model_dump_json()
        settings = SETTINGS.dump_json(self._own.settings())
        again = settings != self._settings or time.monotonic() - self._settings_at > _SETTINGS_AGAIN_S
        self._settings = b""  # what cannot be written is written with the next row
        gateways.write(self._store, self._own.url, self._own.version, present, settings.decode() if again else None)
        self._settings = settings
        if again:
            self._settings_at = time.monotonic()

    def _run(self) -> None:
        due_s, forgotten = time.monotonic(), False
        while not self._over.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + WRITE_S, time.monotonic())
            try:
                self.write()
                if not forgotten:
                    gateways.forget(self._store)
                    forgotten = True
                self._failed = False
            except FolderInUse as error:
                log.error("another service says what this gateway does: %s", error)
                return
            except SQLAlchemyError as error:
                if not temporary(error):
                    log.exception("the row of this gateway cannot be written")
                elif not self._failed:
                    log.warning("the other gateways do not hear of this one, the database takes nothing: %s", error)
                self._failed = True
            except Exception:
                log.exception("defect while saying what this gateway does")
