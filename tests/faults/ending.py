"""How a job and its loop ended after a fault, and what of that is unsafe."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from loopwright.protocol.profile import Mode, NmtState
from loopwright.protocol.real32 import same
from loopwright.protocol.tuner import Tuner, TunerError
from tests.faults.faulty_hub import FaultyHub

NEAR = 1.0
"""Percent: how far MV may be from where it rests, and the plant's from the controller's, between two of its samples."""


@dataclass(frozen=True)
class Home:
    """What the loop must be in the end: as it was found, but for outside changes made meanwhile.

    mv: at which the loop rests in automatic, percent; None where that is not known beforehand.
    output: the manual output found, percent; None where it does not matter.
    """

    mode: Mode
    sp: float
    Kp: float
    Ti: float
    words: str = "as found"
    mv: float | None = None
    output: float | None = None


@dataclass(frozen=True)
class Glance:
    """A loop as its nodes tell by SDO. at: monotonic wall time, s.  Kp, Ti: the accepted ones.

    mv: as the controller has it, and as the plant does.  states: NMT states of both nodes.  session: the number of an
    open one.
    """

    at: float
    mode: int
    sp: float
    on_trial: bool
    session: int
    Kp: float
    Ti: float
    mv: float
    plant_mv: float
    manual_output: float
    safe_output: float
    states: tuple[int, int]


def unsafe(glance: Glance | None, home: Home, at_rest: bool = False) -> str:
    """In what an end is unsafe, in words; empty when it is safe.

    Safe is: the mode found, the set-point found, the accepted gains in effect (not on trial), no session open, both
    nodes operational, and the output that the mode stands for at the plant. at_rest: in automatic MV must be where the
    loop rests, too; it takes the law some time to bring it there.
    """
    if glance is None:
        return "the controller cannot be read"
    wrong = [
        f"{name} is {is_}, not {wanted}"
        for name, is_, wanted, agrees in (
            ("mode", glance.mode, int(home.mode), glance.mode == home.mode),
            ("set-point", glance.sp, home.sp, same(glance.sp, home.sp)),
            ("Kp", glance.Kp, home.Kp, same(glance.Kp, home.Kp)),
            ("Ti", glance.Ti, home.Ti, same(glance.Ti, home.Ti)),
            ("manual output", glance.manual_output, home.output, home.output in (None, glance.manual_output)),
            ("on trial", glance.on_trial, False, not glance.on_trial),
            ("session", glance.session, 0, not glance.session),
            ("NMT states", glance.states, "operational", set(glance.states) == {NmtState.OPERATIONAL}),
        )
        if not agrees
    ]
    if not wrong:
        wanted = {Mode.OFF: glance.safe_output, Mode.MANUAL: glance.manual_output}.get(home.mode)
        if wanted is None and at_rest:
            wanted = home.mv if home.mv is not None else glance.mv
        if wanted is not None and not math.isclose(glance.plant_mv, wanted, abs_tol=NEAR):
            wrong.append(f"MV is {glance.plant_mv}, not {wanted}")
    return "; ".join(wrong)


class Eye:
    """Reads the loop past all faults of the bus, and can keep looking."""

    def __init__(self, hub: FaultyHub) -> None:
        self._tuner = Tuner(hub.onlooker_url, 0x20, 0x10, sdo_tries=2)
        self._turn = threading.Lock()

    def close(self) -> None:
        self._tuner.close()

    def read(self, name: str) -> float:
        """Past all faults of the bus. Raises TunerError."""
        with self._turn:
            return self._tuner.number(name)

    def write(self, name: str, value: float) -> None:
        """Past all faults of the bus. Raises TunerError."""
        with self._turn:
            self._tuner.write(name, value)

    def glance(self) -> Glance | None:
        """None when the controller does not answer."""
        number = self._tuner.number
        with self._turn:
            try:
                return Glance(
                    time.monotonic(),
                    int(number("controller_mode")),
                    number("controller_setpoint"),
                    bool(number("controller_on_trial")),
                    int(number("controller_session")),
                    number("controller_accepted_kp"),
                    number("controller_accepted_ti"),
                    number("controller_mv"),
                    number("plant_mv"),
                    number("controller_manual_output"),
                    number("controller_safe_output"),
                    (int(number("node_state", node=0x20)), int(number("node_state", node=0x10))),
                )
            except TunerError:
                return None

    @contextmanager
    def watching(self, home: Home) -> Iterator[list[float]]:
        """Whenever the loop is seen safe, the time is added to the list."""
        safe: list[float] = []
        over = threading.Event()

        def look() -> None:
            while not over.wait(0.1):
                seen = self.glance()
                if seen is not None and not unsafe(seen, home):
                    safe.append(seen.at)

        thread = threading.Thread(target=look, daemon=True)
        thread.start()
        try:
            yield safe
        finally:
            over.set()
            thread.join()

    def settled(self, home: Home, within_s: float) -> Glance | None:
        """The loop as soon as it is safe and at rest, or as it is after that time."""
        give_up = time.monotonic() + within_s
        while True:
            seen = self.glance()
            if not unsafe(seen, home, at_rest=True) or time.monotonic() > give_up:
                return seen
            time.sleep(0.1)


class Stalls:
    """How long at most this process was not let run, s: what the machine itself does to whoever counts seconds."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        began = time.monotonic()
        while not self._over.wait(0.05):
            now = time.monotonic()
            self.longest_s = max(self.longest_s, now - began - 0.05)
            began = now


@dataclass
class Ending:
    """A line of the campaign. safe_s: from the fault until the controller was seen safe; None: the job went on to its
    proposal, and no fault had made the loop safe before.  kept: samples taken before the fault that are stored.
    lost: those that are not.  missing: those that never came over the bus.
    loop: how the loop had to end.  defects: HTTP answers of 5xx that are not documented, ends that are not.
    stall_s: how long the machine stood still.  earlier: kept from a run of an earlier state of this harness.
    """

    database: str
    fault: str
    stage: str
    state: str
    reason: str | None
    detail: str | None
    attempts: int
    safe_s: float | None
    kept: int
    lost: int
    missing: int
    unsafe: str
    loop: str = "as found"
    defects: list[str] = field(default_factory=list)
    took_s: float = 0.0
    stall_s: float = 0.0
    earlier: bool = False

    @property
    def key(self) -> tuple[str, str, str]:
        return self.database, self.fault, self.stage

    @property
    def active(self) -> bool:
        return self.state in ("queued", "running")

    @property
    def bad(self) -> bool:
        return bool(self.unsafe or self.defects or self.active)
