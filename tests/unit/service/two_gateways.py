"""Two gateways over one PostgreSQL database in one process, with controllers that are stand-ins."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import httpx
from fastapi.testclient import TestClient
from sqlalchemy import text

from loopwright.service.alarms.alarm import Alarm
from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.inputs.config import parse_site
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.forwarded_decisions import PATIENCE_S
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.manager import Jobs
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.listening.listening import Listening
from loopwright.service.live.other_gateways import LOOK_S, OtherGateways
from loopwright.service.live.own_gateway import Announcing, OwnGateway
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.gateways import NOW_S
from loopwright.service.store.store import Store
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import FakeController, FakeLoop, FakeTune, ThreadEngine, fake_rehearse, loop_entry
from tests.unit.service.processes import until

T = TypeVar("T")
HERE, THERE = "gw-1", "gw-2"
TAG_HERE, TAG_THERE = "TIC-1", "TIC-2"


class Hearing(Listening):
    """What the process that listens has said, without one."""

    def hears(self, heard: Heard | None, down: str | None = None) -> None:
        """down: why no bus is heard."""
        self.off, self._started, self._begun = {}, True, True
        self._down = dict.fromkeys(self.buses(), down) if down else {}
        self.heard = dict.fromkeys(self._loops, heard) if heard else {}


class HeldClock(Machine):
    """A clock that stands still: what waits for an answer waits until a test says that the time is over."""

    now_s = 0.0
    sleeps = 0
    """How often somebody has waited."""

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.sleeps += 1
        super().sleep(seconds)


class OneGateway:
    """A gateway with one loop."""

    def __init__(self, folder: Path, database: str, name: str, tag: str) -> None:
        self.name, self.tag = name, tag
        self.controller, self.tune, self.clock = FakeController(), FakeTune(), HeldClock()
        self.store = Store(folder / name, database, name)
        self.jobs = self.make_jobs()
        self.jobs.boot()
        self.listening = Hearing(self.jobs.directory.loops, self.store, on=False)
        self._later_s = self.alarms_later_s = 0.0
        self.others = OtherGateways(self.store, lambda: time.monotonic() + self._later_s)
        self.watch = AlarmWatch(self.jobs, self.listening, self.others, lambda: time.time() + self.alarms_later_s)
        self.own = OwnGateway(self.jobs, self.listening, f"https://{name}.example", self.watch)
        self.announcing = Announcing(self.jobs, self.own)
        self.app = app_of(
            self.jobs, checks={}, listening=self.listening, alarms=self.watch, own=self.own, others=self.others
        )
        self.http = TestClient(self.app, raise_server_exceptions=False)
        # FastAPI builds its routes with the first requests, and silences warnings of the whole process meanwhile: two
        # gateways that do so at once, which one service never does, would not silence all of them.
        assert self.http.get("/nowhere").status_code == 404

    def make_jobs(self) -> Jobs:
        loops = parse_site({"loops": [loop_entry(tag=self.tag)]}, "test").loops
        open_loop: Callable[[Any], FakeLoop] = lambda config: FakeLoop(self.controller)  # noqa: E731
        settings = {"engine": ThreadEngine(), "machine": self.clock}
        return make_jobs(loops, self.store, open_loop, self.tune, fake_rehearse, **settings)  # type: ignore[arg-type]

    def proposed(self) -> str:
        """The id of a job that has just proposed gains."""
        row = self.jobs.start(self.tag, FastRetune())
        until(lambda: self.store.get(row.id).state == "proposed")
        return row.id

    def decide(self, job_id: str, what: str, **headers: str) -> httpx.Response:
        names = {name.replace("_", "-"): value for name, value in headers.items()}
        return self.http.post(f"/jobs/{job_id}/{what}", json={"by": "A. Lind"}, headers=names)

    def lose_patience(self) -> None:
        """Whoever waits here for the answer of another gateway has waited long enough."""
        self.clock.now_s += PATIENCE_S

    def look_again(self) -> None:
        """The next who asks for the other gateways has the database asked."""
        self._later_s += LOOK_S

    def alarms_after(self, seconds: float) -> list[Alarm]:
        """What is abnormal here when so much time has passed, with what the others have said by then."""
        self.alarms_later_s += seconds
        self.look_again()
        return list(self.watch.look())

    def requests(self) -> list[tuple[str, str]]:
        """What is asked and the state of every request, as the database has them."""
        with self.store.reading() as session:
            found = session.execute(text("SELECT what, state FROM decision_requests ORDER BY number"))
            return [(row.what, row.state) for row in found]

    def sql(self, statement: str, **values: object) -> None:
        with self.store.engine.begin() as connection:
            connection.execute(text(statement), values)

    def close(self) -> None:
        self.tune.hold.set()
        self.announcing.close()
        self.jobs.stop()
        self.store.close()


class TwoGateways:
    """here: the gateway that is asked.  there: the gateway that has the loop, and has written its row."""

    def __init__(self, folder: Path, database: str) -> None:
        self.decided = ThreadPoolExecutor(4)
        self.here = OneGateway(folder, database, HERE, TAG_HERE)
        self.there = OneGateway(folder, database, THERE, TAG_THERE)
        self.write()

    def write(self) -> None:
        """The gateway there writes its row, which stays new however long a test takes."""
        self.there.announcing.write()
        self.age(-1e6)

    def age(self, seconds: float) -> None:
        """The row of the gateway there was written so long ago."""
        self.here.sql(f"UPDATE gateways SET at_s = {NOW_S} - :by WHERE name = :name", by=seconds, name=THERE)

    def asked(self, job_id: str, what: str = "accept") -> Future[httpx.Response]:
        """A decision that is asked here, as `waiting`."""
        return self.waiting(self.here.decide, job_id, what)

    def waiting(self, call: Callable[..., T], *given: object) -> Future[T]:
        """A call of the gateway here, as soon as it waits for the gateway there, or has its answer."""
        before = self.here.clock.sleeps
        found = self.decided.submit(call, *given)
        until(lambda: self.here.clock.sleeps > before or found.done())
        return found

    def stop_looking(self) -> None:
        """The gateway there lives, and begins nothing that is asked of it."""
        self.there.jobs.requested_decisions.close()


@contextmanager
def two_gateways(folder: Path, database: str) -> Iterator[TwoGateways]:
    found = TwoGateways(folder, database)
    try:
        yield found
    finally:
        found.here.lose_patience()  # a test that has failed may have left somebody waiting
        found.decided.shutdown()
        found.here.close()
        found.there.close()
