"""What the other gateways of the shared database say of their loops: one query a second, whoever asks and how often."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from pydantic import ValidationError
from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.alarms.alarm import Alarm
from loopwright.service.live.messages import BusView, LoopValues
from loopwright.service.live.rows import no_values, old
from loopwright.service.live.snapshot import SETTINGS, JobProgress, LoopSettings, Present
from loopwright.service.store import gateways
from loopwright.service.store.gateways import LOST_S, NO_DATA_S, GatewaySaid, silent
from loopwright.service.store.store import Store

LOOK_S = 0.9
"""Age up to which an answer of the database is used again, s."""


@dataclass(frozen=True)
class OtherGateway:
    """A gateway as it was read last.

    said: its row.  values, settings: of its loops, by tag.  jobs: those that run there, by id.
    alarms: what only it can know of what is abnormal.
    not_readable: why its values are not known although it was there; None: they are.
    """

    said: GatewaySaid
    values: Mapping[str, LoopValues]
    settings: Mapping[str, LoopSettings]
    jobs: Mapping[str, JobProgress]
    buses: Sequence[BusView]
    alarms: Sequence[Alarm]
    not_readable: str | None


class OtherGateways:
    """Knows what the other gateways have said. Several threads may ask.

    monotonic: the clock by which what was read grows older, s.
    """

    def __init__(self, store: Store, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._store, self._monotonic = store, monotonic
        self._lock = threading.Lock()
        self._looked_s = -math.inf
        self._database_away = False
        self._found: Mapping[str, OtherGateway] = {}

    def look(self) -> None:
        """Asks the database, unless it was asked just now. Raises SQLAlchemyError."""
        if not self._store.shared:
            return
        with self._lock:
            now_s = self._monotonic()
            if now_s - self._looked_s < LOOK_S:
                return
            try:
                rows = gateways.every(self._store)
            except SQLAlchemyError:
                self._database_away = True
                raise
            self._database_away = False
            before = self._found
            self._found = {name: _read(said, before.get(name)) for name, said in rows.items()}
            self._looked_s = now_s

    def every(self) -> Mapping[str, OtherGateway]:
        """Returns the gateways that have a row, this one too, by name."""
        return self._found

    def age_s(self, name: str) -> float | None:
        """Returns how old the row of a gateway is by now, s; None: it has none."""
        found = self._found.get(name)
        return None if found is None else found.said.age_s + self._away_s

    @property
    def _away_s(self) -> float:
        """How long ago the database was asked, s."""
        return max(0.0, self._monotonic() - self._looked_s)

    def answers(self, name: str) -> bool:
        """Returns whether a gateway was there within LOST_S."""
        age_s = self.age_s(name)
        return age_s is not None and age_s <= LOST_S

    def why_no_data(self, name: str) -> str | None:
        """Returns why nothing is known of the present state of a gateway's loops; None: it is known."""
        age_s = self.age_s(name)
        if age_s is not None and age_s <= NO_DATA_S:
            return self._found[name].not_readable
        if self._database_away:
            return f"no data from gateway {name}: the database, by which it is seen, does not answer"
        if self._away_s > NO_DATA_S:
            return f"no data from gateway {name} yet"
        if age_s is None or age_s > LOST_S:
            return silent(name, age_s)
        return f"no data from gateway {name} for {age_s:.0f} s"

    def values(self, tag: str, name: str) -> LoopValues:
        """Returns what was heard last of a loop of another gateway; of a gateway that has fallen silent, what it
        has said last, as old values."""
        found = self._found.get(name)
        values = None if found is None else found.values.get(tag)
        age_s = self.age_s(name)
        last = None if values is None else old(values)
        sample_s = None
        if values is not None and age_s is not None and (values.age_s is not None or last is not None):
            sample_s = age_s + (values.age_s or 0.0)  # what a job has read has no age of its own
        why = self.why_no_data(name)
        if why is None and values is None:
            why = f"gateway {name} does not have the loop"
        if why is not None or values is None:
            return no_values(tag, why, sample_s, last)
        return values.model_copy(update={"age_s": None if sample_s is None else round(sample_s, 3)})

    def settings(self, tag: str, name: str) -> LoopSettings | None:
        """Returns what was read of a loop's controller; None: it is not known."""
        found = self._found.get(name)
        return None if found is None or self.why_no_data(name) is not None else found.settings.get(tag)

    def progress(self, job_id: str, name: str) -> JobProgress | None:
        """Returns how far a running job of another gateway has come; None: it is not known."""
        found = self._found.get(name)
        if found is None or self.why_no_data(name) is not None:
            return None
        return found.jobs.get(job_id)

    def alarms(self, name: str) -> Sequence[Alarm]:
        """Returns what a gateway has said last of what only it can know of what is abnormal."""
        found = self._found.get(name)
        return () if found is None else found.alarms

    def buses(self) -> list[BusView]:
        """Returns the buses of the other gateways."""
        found = []
        for name, each in self._found.items():
            if name != self._store.host:
                why = self.why_no_data(name)
                known = {"gateway": name} if why is None else {"gateway": name, "up": None, "why": why}
                found += [bus.model_copy(update=known) for bus in each.buses]
        return found


def _read(said: GatewaySaid, before: OtherGateway | None) -> OtherGateway:
    """Reads the JSON of a row; settings that are as before are not read again."""
    try:
        now = Present.model_validate_json(said.present)
        same = before is not None and before.not_readable is None and before.said.settings == said.settings
        settings = before.settings if same and before is not None else SETTINGS.validate_json(said.settings)
    except ValidationError as error:
        fields = ", ".join(sorted({str(each["loc"][0]) for each in error.errors() if each["loc"]}))
        why = f"what gateway {said.name} of version {said.version} says cannot be read here ({fields})"
        return OtherGateway(said, {}, {}, {}, [], [], why)
    values = {each.tag: each for each in now.loops}
    return OtherGateway(said, values, settings, {each.id: each for each in now.jobs}, now.buses, now.alarms, None)
