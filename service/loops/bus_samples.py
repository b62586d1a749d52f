"""The samples of a loop on the bus: it drives, counts and times them.

A simulated plant that runs as fast as the answers come (pace 0) is run in blocks of samples: no sample is lost however
slow the service is, and commands act between two blocks, so equal seeds give equal runs.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import suppress

from loopwright.protocol.patience import WAIT_S
from loopwright.protocol.process_data import BusSample
from loopwright.protocol.profile import FOREVER, node_name, samples_between
from loopwright.protocol.tuner import Tuner
from loopwright.service.loops.bus_connection import BusConnection
from loopwright.service.loops.bus_session import BusSession
from loopwright.service.telemetry.metrics import SAMPLES_LOST
from loopwright.tuning.plan import Sample
from loopwright.tuning.reasons import Ended, Failed, Reason

HALT_S, HALT_AGAIN_S = 5.0, 0.5
"""Longest time that a plant run in blocks may take to halt, and the time after which the order to halt is repeated,
s."""
SILENCE_S = 1.0
"""Wall time without a sample (at least three sampling periods) after which the nodes are asked for an answer, s."""
MAX_GAP = 5
"""Largest number of samples in a row that may be missing."""
BLOCK = 10
"""Samples per block of a plant at pace 0."""
_HALTED_S = 0.03  # time without a sample after which the plant has halted


class BusSamples:
    """Counts the samples of the channel of a connection from the beginning of a test.

    check_stop_request: as for the session.
    block: samples per block of a plant at pace 0.
    max_gap: samples in a row that may be missing.
    """

    def __init__(
        self,
        connection: BusConnection,
        session: BusSession,
        check_stop_request: Callable[[str], None],
        block: int,
        max_gap: int,
    ) -> None:
        self.in_blocks = False
        self.pace = 1.0
        self.sample_time_s = 0.0
        self._connection, self._session = connection, session
        self._station = connection.station
        self._check_stop_request = check_stop_request
        self._block = block
        self._max_gap = max_gap
        self._plant_lock: threading.Lock | None = None
        self._halted = False
        self._silence_s = SILENCE_S
        self._left = 0  # samples of the present block still to come
        self._first_n: int | None = None
        self._last_n = 0
        self._passed = 0

    # -- who drives the samples

    def read_pace(self, tuner: Tuner) -> None:
        self.pace = tuner.number("plant_pace") if self._connection.plant is not None else 1.0

    def read_sample_time(self, tuner: Tuner) -> None:
        self.sample_time_s = tuner.number("sample_time", node=self._connection.controller) / 1e6

    def take_plant(self, tuner: Tuner) -> None:
        """Waits for the lock of a plant that is run in blocks, before the controller is commanded."""
        self.read_sample_time(tuner)
        self.read_pace(tuner)
        self.in_blocks = self.pace == 0.0
        plant = self._connection.plant
        if not self.in_blocks or plant is None:
            return
        lock = self._station.plant_lock(self._connection.url, plant)
        while not lock.acquire(timeout=0.1):
            self._check_stop_request(f"while another test was using plant node {node_name(plant)}")
        self._plant_lock = lock

    def begin(self, tuner: Tuner) -> None:
        """Determines whether the plant's clock or this service (in blocks) drives the samples, and starts counting
        them. No other test may still use the plant."""
        self._silence_s = max(SILENCE_S, 3.0 * self.sample_time_s / (self.pace or math.inf))
        if self.in_blocks:
            self._halted = True
            self._halt(tuner)
        elif self._connection.plant is not None and not tuner.number("plant_samples_to_run"):
            tuner.write("plant_samples_to_run", FOREVER)
        tuner.drain()
        self._first_n, self._left, self._passed = None, 0, 0

    def _halt(self, tuner: Tuner) -> None:
        """Halts the plant. The order is repeated, because a plant that is reset meanwhile runs again.

        The samples from before the halt are dropped at once: a plant at full speed leaves more of them, while a busy
        gateway opens its session, than can be counted one by one in the time that a halt may take.
        """
        give_up = self._station.monotonic() + HALT_S
        again_at = 0.0
        while True:
            now = self._station.monotonic()
            if now >= again_at:
                tuner.write("plant_samples_to_run", 0)
                again_at = now + HALT_AGAIN_S
            tuner.drain()
            if tuner.sample(_HALTED_S) is None:
                return
            self._check_stop_request("while the plant was brought to a halt")
            self._session.confirm_if_due(tuner)
            if now > give_up:
                node = f"plant node {node_name(self._connection.plant or 0)}"
                raise Failed(Reason.SAMPLES_LOST, f"{node} runs on although it was ordered to halt (2011h)")

    def release(self) -> None:
        """Lets a plant that was run in blocks run on by itself, and releases its lock."""
        if self._halted:
            with suppress(Ended), self._connection.tuner() as tuner:
                tuner.write("plant_samples_to_run", FOREVER)
            self._halted = False
        if self._plant_lock is not None:
            self._plant_lock.release()
            self._plant_lock = None

    # -- sample by sample

    @property
    def block_is_over(self) -> bool:
        """Returns whether commands act now; they always do where the plant's clock drives the samples."""
        return self._left <= 0

    def start_block(self, tuner: Tuner) -> None:
        """Lets a plant at pace 0 run the next block."""
        if self.in_blocks:
            tuner.write("plant_samples_to_run", self._block)
            self._left = self._block

    def next(self, tuner: Tuner) -> Sample:
        """Waits for the next sample and counts it. Raises Failed(SAMPLES_LOST | NODE_NOT_OPERATIONAL), the reason why
        the session is over, and the error of a stop request."""
        return self._count(self._wait_for_next(tuner))

    def _wait_for_next(self, tuner: Tuner) -> BusSample:
        give_up: float | None = None
        while True:
            sample = tuner.sample(WAIT_S)  # lease and stop requests are checked after each
            self._session.check_status(tuner)
            if sample is not None and (self._first_n is None or sample.n != self._last_n):  # a frame may come twice
                return sample
            now = self._station.monotonic()
            give_up = give_up or now + self._silence_s
            if now > give_up:
                raise self._silent(tuner)
            self._session.confirm_if_due(tuner)
            self._check_stop_request("while waiting for a sample")

    def _silent(self, tuner: Tuner) -> Ended:
        """Returns the error to raise when no sample comes. A node that is gone raises by its time-out."""
        reading = self._connection.reading(tuner)
        reading.check_controller_operational()
        reading.check_plant_operational()
        if not self._session.is_open(tuner):
            return self._session.why_over(tuner)
        return Failed(Reason.SAMPLES_LOST, f"no sample for {self._silence_s:g} s although the nodes answer")

    def _count(self, sample: BusSample) -> Sample:
        first = self._first_n is None
        if first:
            self._first_n = sample.n
        passed = 1 if first else samples_between(self._last_n, sample.n)
        self._last_n = sample.n
        if passed < 1:
            raise Failed(Reason.SAMPLES_LOST, f"the plant started anew: sample {sample.n} after {sample.n - passed}")
        if passed > 1:
            SAMPLES_LOST.labels(self._connection.url).inc(passed - 1)
        if passed > self._max_gap + 1:
            raise Failed(Reason.SAMPLES_LOST, f"{passed - 1} samples missing before sample {sample.n}")
        self._left -= passed if self.in_blocks else 0
        self._passed += passed
        return Sample((self._passed - 1) * self.sample_time_s, sample.sp, sample.pv, sample.mv, sample.mode)
