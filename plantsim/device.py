"""The plant I/O device: it drives the samples by SYNC and PV, waits for the answering MV, and steps the plants."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from loopwright.plantsim.plant import Plant
from loopwright.protocol.bus import Bus
from loopwright.protocol.device_runtime import Runtime
from loopwright.protocol.object_dictionary import Dictionary
from loopwright.protocol.objects import Device, Value
from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    FOREVER,
    MV_FRAME,
    PLANT_NODE,
    PV_FRAME,
    SYNC_COUNTER_OVERFLOW,
    SYNC_FRAME,
    SYNC_ID,
    UNASKED,
    Abort,
    Emcy,
    NmtState,
    OnMissingAnswer,
    channel_ids,
)
from loopwright.protocol.real32 import nearest
from loopwright.protocol.sdo import SdoAbort

_MAX_CATCH_UP = 5
"""Number of sampling periods by which the pace may lag behind the wall clock before the lost time is given up."""


@dataclass(frozen=True, slots=True)
class PlantChannel:
    """Describes how to make a plant: build(sample_time_s, noise_std, seed). mv_nominal in percent; noise_std in PV
    units."""

    build: Callable[[float, float, int], Plant]
    mv_nominal: float = 50.0
    noise_std: float = 0.0


class PlantDevice:
    """The plant I/O on its bus.

    pace: 0 for as fast as the answers come, 1 for real time, x for x times as fast.
    run: samples to run at once (2011h).
    """

    def __init__(
        self,
        bus: Bus,
        channels: Sequence[PlantChannel],
        sample_time_s: float = 0.1,
        pace: float = 1.0,
        run: int = FOREVER,
        seed: int = 1,
        node: int = PLANT_NODE,
        controller_node: int = CONTROLLER_NODE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._channels = channels
        self._count = count = len(channels)
        self.sample_time_s = sample_time_s
        self.dictionary = dictionary = Dictionary(Device.PLANT, count, node, controller_node)
        self.runtime = runtime = Runtime(bus, node, dictionary, clock)
        self._send = bus.send
        self.pace = pace
        self._remaining = self._run = run
        self._missing_in_all = 0
        self._next_at: float | None = None
        ids = [channel_ids(k, node, controller_node) for k in range(1, count + 1)]
        self._pv_ids = [each.pv for each in ids]
        runtime.handlers = {each.mv: partial(self._on_mv, at) for at, each in enumerate(ids)}
        runtime.lengths = {each.mv: MV_FRAME.size for each in ids}
        runtime.on_tick = self._on_tick
        runtime.on_due = self._on_due
        runtime.on_leave_operational = lambda: self._unanswered.clear()
        runtime.on_reset = self._on_reset
        dictionary.set("sample_time", round(sample_time_s * 1e6))
        dictionary.set("plant_pace", pace)
        dictionary.set("plant_seed", seed)
        for at, channel in enumerate(channels):
            dictionary.set("plant_noise", channel.noise_std, at + 1)
            dictionary.set("plant_safe_output", channel.mv_nominal, at + 1)
        self._connect(dictionary)
        self._initialise()

    def start(self) -> None:
        self.runtime.start()
        self._schedule()

    def _on_reset(self) -> None:
        """Restores the state at the start of the program; all later writes are lost."""
        self.dictionary.restore(0x2000, 0xFFFF)
        self.pace = float(self.dictionary.get("plant_pace"))
        self._remaining = self._run
        self._missing_in_all = 0
        self._initialise()
        self._schedule()

    def _initialise(self) -> None:
        """Puts every plant at rest, with sample number 0; equal seeds give equal runs."""
        seed = int(self.dictionary.get("plant_seed"))
        self.plants = [
            channel.build(self.sample_time_s, float(self.dictionary.get("plant_noise", at + 1)), seed + at)
            for at, channel in enumerate(self._channels)
        ]
        for at, plant in enumerate(self.plants):
            plant.disturbance = float(self.dictionary.get("plant_disturbance", at + 1))
            plant.gain = float(self.dictionary.get("plant_gain", at + 1))
        self.mv = [channel.mv_nominal for channel in self._channels]
        self.number = 0
        self._sync_counter = 0
        self._unanswered: set[int] = set()
        self._waiting: tuple[int, float] = (0, 0.0)
        self._answered_number = 0
        self._next_at = None

    # The sample

    def _sample(self) -> None:
        """Latches the outputs, integrates one step, and sends SYNC and the PV with its number."""
        if self._remaining != FOREVER:
            self._remaining -= 1
        self.number = number = self.number % 0xFFFFFFFF + 1  # 0 is UNASKED
        self._sync_counter = self._sync_counter % SYNC_COUNTER_OVERFLOW + 1
        self._unanswered.update(range(self._count))
        values = [plant.step(mv) for plant, mv in zip(self.plants, self.mv, strict=True)]
        self._send(SYNC_ID, SYNC_FRAME.pack(self._sync_counter))
        for can_id, pv in zip(self._pv_ids, values, strict=True):
            self._send(can_id, _pv_frame(pv, number))

    def _on_mv(self, at: int, data: bytes) -> None:
        mv, number = MV_FRAME.unpack(data)
        if (number != self.number and number != UNASKED) or mv - mv != 0.0:
            return  # an answer to another sample, or MV is not a number: this sample stays unanswered
        self.mv[at] = 0.0 if mv < 0.0 else 100.0 if mv > 100.0 else mv
        if number == UNASKED:
            return
        self._unanswered.discard(at)
        if not self._unanswered:
            self._answered_number = number
            if self._missing_in_all:
                self.runtime.clear_error(Emcy.NO_ANSWER)
            self._advance()

    def _advance(self) -> None:
        """Ends the sample; the next one follows at once, at its time, or not at all."""
        if self.pace == 0.0:
            if self._remaining and self.runtime.state is NmtState.OPERATIONAL:
                self._sample()
        else:
            self._schedule()

    def _schedule(self) -> None:
        """Sets the next due time. Due times follow the pace, not the end of the last sample, so the mean rate is
        right."""
        if not self._remaining:
            self.runtime.due = None
            return
        now = self.runtime.clock()
        if self.pace == 0.0 or self._next_at is None:
            self._next_at = now
        else:
            period = self.sample_time_s / self.pace
            self._next_at += period
            if self._next_at < now - _MAX_CATCH_UP * period:
                self._next_at = now
        self.runtime.due = self._next_at

    def _on_due(self) -> None:
        if self._remaining and not self._unanswered and self.runtime.state is NmtState.OPERATIONAL:
            self._sample()

    # Missing answers

    def _on_tick(self, now: float) -> None:
        if self.runtime.state is not NmtState.OPERATIONAL:
            return
        if not self._unanswered:
            if self._remaining and self.runtime.due is None:
                self._schedule()  # operational again after a pause
            return
        number, since = self._waiting
        if number != self.number:
            self._waiting = (self.number, now)
        elif now - since > int(self.dictionary.get("plant_answer_timeout")) / 1000.0:
            self._give_up_waiting()

    def _give_up_waiting(self) -> None:
        missing = sorted(self._unanswered)
        self._unanswered.clear()
        self._missing_in_all += 1
        reaction = int(self.dictionary.get("plant_on_missing_answer"))
        if reaction == OnMissingAnswer.STOP_RUN:
            self._remaining = 0
        elif reaction == OnMissingAnswer.SAFE_OUTPUT:
            for at in missing:
                self.mv[at] = float(self.dictionary.get("plant_safe_output", at + 1))
        try:
            self.runtime.raise_error(Emcy.NO_ANSWER, bytes((missing[0] + 1,)))
        finally:  # reaction and time do not depend on a bus that takes the frame
            self._advance()

    # The object dictionary

    def _connect(self, dictionary: Dictionary) -> None:
        dictionary.on_read.update(
            {
                "sample_number": lambda sub: self.number,
                "plant_output_sample_number": lambda sub: self._answered_number,
                "plant_samples_to_run": lambda sub: self._remaining,
                "plant_missing_answers": lambda sub: self._missing_in_all,
                "plant_pv": lambda sub: self.plants[sub - 1].pv,
                "plant_mv": lambda sub: self.mv[sub - 1],
            }
        )
        dictionary.on_write.update(
            {
                "sample_time": self._write_sample_time,
                "plant_pace": self._write_pace,
                "plant_samples_to_run": self._write_run,
                "plant_disturbance": self._write_disturbance,
                "plant_gain": self._write_gain,
                "plant_noise": self._write_noise,
                "plant_seed": self._only_held,
                "plant_initialise": self._write_initialise,
                "plant_mv": self._write_mv,
            }
        )

    def _only_held(self, sub: int, value: Value) -> None:
        if self._remaining:
            raise SdoAbort(Abort.DEVICE_STATE)

    def _write_initialise(self, sub: int, value: Value) -> None:
        self._only_held(sub, value)
        self._initialise()

    def _write_sample_time(self, sub: int, value: Value) -> None:
        if self.runtime.state is not NmtState.PRE_OPERATIONAL:
            raise SdoAbort(Abort.DEVICE_STATE)
        before, self.sample_time_s = self.sample_time_s, int(value) / 1e6
        try:
            self._initialise()
        except ValueError:
            self.sample_time_s = before
            raise SdoAbort(Abort.INVALID_VALUE) from None

    def _write_pace(self, sub: int, value: Value) -> None:
        self.pace = float(value)
        self._next_at = None
        if not self._unanswered:
            self._schedule()

    def _write_run(self, sub: int, value: Value) -> None:
        was_held = not self._remaining
        self._remaining = int(value)
        if was_held:
            self._next_at = None
            if not self._unanswered:
                self._schedule()

    def _write_disturbance(self, sub: int, value: Value) -> None:
        self.plants[sub - 1].disturbance = float(value)

    def _write_gain(self, sub: int, value: Value) -> None:
        self.plants[sub - 1].gain = float(value)

    def _write_noise(self, sub: int, value: Value) -> None:
        self.plants[sub - 1].noise_std = float(value)

    def _write_mv(self, sub: int, value: Value) -> None:
        self.mv[sub - 1] = float(value)


def _pv_frame(pv: float, number: int) -> bytes:
    """Returns the frame of a PV; beyond the range of a REAL32, as of a plant that runs away, it is infinite."""
    try:
        return PV_FRAME.pack(pv, number)
    except OverflowError:
        return PV_FRAME.pack(nearest(pv), number)
