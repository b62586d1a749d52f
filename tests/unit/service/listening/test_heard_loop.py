"""From frames to history: lost, doubled and foreign frames, restarts, and what is not known."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from loopwright.protocol.profile import MV_FRAME, PV_FRAME, STATUS_FRAME, UNASKED, Mode
from loopwright.service.listening.bins import UNKNOWN_MODE
from loopwright.service.listening.heard_loop import READ_AGAIN_S, SILENCE_S, HeardLoop, InEffect

T0 = 1_769_860_800.0
ONE = (1.5, 20.0, 0.0, 0.0, 1.0, 0.0)
FOUND = InEffect(T0 - 1.0, 50.1, Mode.AUTOMATIC, False, ONE, 0.1)


class Bus:
    """The frames of a loop with ten samples a second."""

    def __init__(self) -> None:
        self.loop = HeardLoop()
        self.at_s = T0

    def sample(self, n: int, pv: float = 50.0, mv: float = 40.0, seconds: float = 0.1) -> None:
        self.at_s += seconds
        self.loop.take_pv(PV_FRAME.pack(pv, n), self.at_s)
        self.loop.take_mv(MV_FRAME.pack(mv, n), self.at_s)

    def status(self, sp: float, mode: Mode = Mode.AUTOMATIC, on_trial: bool = False, is_open: bool = False) -> None:
        self.loop.take_status(STATUS_FRAME.pack(mode, on_trial, sp, is_open, 0), self.at_s)

    def read(self, **changes: object) -> None:
        """The service reads and tells; both at once."""
        self.at_s += 0.01
        self.loop.learn(replace(FOUND, began_s=self.at_s - 0.005, **changes), self.at_s)

    @property
    def bins(self) -> np.ndarray:
        return self.loop.rings.rows(T0, self.at_s + 1.0, 5000).bins

    @property
    def gaps(self) -> list[tuple[float, float]]:
        return [gap for gap in self.loop.rings.rows(T0, self.at_s + 1.0, 5000).gaps if gap[0] > -math.inf]


@pytest.fixture
def bus() -> Bus:
    return Bus()


def test_samples_have_the_values_that_were_sent(bus: Bus) -> None:
    bus.sample(7, 50.05, 41.3)
    (one,) = bus.bins
    assert (one["n"], one["pv_mean"], one["mv_mean"]) == (7, np.float32(50.05), np.float32(41.3))
    assert one["at_s"] == bus.at_s


@pytest.mark.parametrize("lost", ["pv", "mv"])
def test_a_lost_frame_is_a_gap(bus: Bus, lost: str) -> None:
    for n in range(1, 5):
        bus.sample(n)
    before_s = bus.at_s
    if lost == "mv":
        bus.loop.take_pv(PV_FRAME.pack(99.0, 5), bus.at_s + 0.1)
    else:
        bus.loop.take_mv(MV_FRAME.pack(99.0, 5), bus.at_s + 0.1)
    bus.sample(6, seconds=0.2)
    assert bus.bins["n"].tolist() == [1, 2, 3, 4, 6] and bus.bins["pv_max"].max() == 50.0
    assert bus.gaps == [(before_s, bus.at_s)]


def test_a_doubled_frame_is_no_sample(bus: Bus) -> None:
    for n in (1, 2, 2, 3):
        bus.sample(n)
    bus.loop.take_mv(MV_FRAME.pack(40.0, 3), bus.at_s + 0.01)
    assert bus.bins["n"].tolist() == [1, 2, 3] and not bus.gaps


def test_frames_that_answer_nothing_or_are_foreign_are_no_samples(bus: Bus) -> None:
    bus.sample(1)
    bus.loop.take_mv(MV_FRAME.pack(10.0, UNASKED), bus.at_s)
    bus.loop.take_mv(MV_FRAME.pack(10.0, 17), bus.at_s)
    for take in (bus.loop.take_pv, bus.loop.take_mv, bus.loop.take_status):
        with pytest.raises(struct.error):
            take(b"\0\0\0", bus.at_s)
    bus.sample(2)
    assert bus.bins["n"].tolist() == [1, 2] and not bus.gaps


def test_a_plant_that_begins_anew_and_numbers_that_wrap(bus: Bus) -> None:
    for n in (0xFFFFFFFE, 0xFFFFFFFF, 1, 2):
        bus.sample(n)
    assert not bus.gaps
    bus.sample(1)
    assert len(bus.gaps) == 1 and len(bus.bins) == 5


def test_a_silence_is_a_gap_although_no_sample_is_missing(bus: Bus) -> None:
    for n in range(1, 4):
        bus.sample(n)
    bus.sample(4, seconds=SILENCE_S + 0.5)
    assert len(bus.gaps) == 1


def test_a_slow_loop_has_no_gaps(bus: Bus) -> None:
    for n in range(1, 60):
        bus.sample(n, seconds=SILENCE_S - 0.1)
    assert not bus.gaps and bus.loop.silent_from_s(bus.at_s + 3.0) == math.inf
    assert bus.loop.silent_from_s(bus.at_s + 4.0 * SILENCE_S) == bus.at_s


@pytest.mark.parametrize("period_s", [SILENCE_S + 0.1, 30.0, 600.0])
def test_a_loop_whose_samples_are_farther_apart_than_a_silence_is_heard(bus: Bus, period_s: float) -> None:
    bus.sample(1)
    for n in range(2, 20):
        bus.sample(n, seconds=period_s)
        if bus.loop.to_read(bus.at_s):
            bus.read()
    assert not bus.gaps and bus.bins["gains"][-1]
    assert bus.loop.silent_from_s(bus.at_s + 2.0 * period_s) == math.inf
    assert bus.loop.silent_from_s(bus.at_s + 4.0 * period_s) < math.inf


def test_until_the_second_sample_the_period_is_the_one_that_the_controller_reports(bus: Bus) -> None:
    bus.sample(1)
    assert bus.loop.silent_from_s(bus.at_s + SILENCE_S + 0.1) == bus.at_s
    bus.read(sample_time_s=5.0)
    first_s = bus.at_s
    assert bus.loop.silent_from_s(first_s + 14.0) == math.inf
    assert bus.loop.silent_from_s(first_s + 16.0) < math.inf
    bus.sample(2, seconds=5.0)
    assert not bus.gaps and bus.bins["gains"][-1]


def test_samples_that_come_faster_than_the_controller_reports_count(bus: Bus) -> None:
    """As those of a simulated plant do that runs ahead of the clock."""
    bus.sample(1)
    bus.read(sample_time_s=5.0)
    bus.sample(2)
    assert bus.loop.silent_from_s(bus.at_s + SILENCE_S + 0.1) == bus.at_s


def test_a_loop_that_is_made_slower_is_heard_again_and_a_single_silence_makes_none_slow(bus: Bus) -> None:
    for n in range(1, 60):
        bus.sample(n)
    bus.sample(60, seconds=3600.0)
    assert bus.loop.silent_from_s(bus.at_s + SILENCE_S + 0.1) == bus.at_s
    for n in range(61, 160):
        bus.sample(n, seconds=30.0)
    assert not bus.bins["gap"][-80:].any() and bus.loop.silent_from_s(bus.at_s + 60.0) == math.inf


def test_a_bus_that_was_away_is_a_gap(bus: Bus) -> None:
    bus.sample(1)
    bus.sample(2)
    bus.loop.interrupted()
    bus.sample(3)
    assert len(bus.gaps) == 1


def test_set_point_mode_and_gains_are_unknown_until_they_are_read(bus: Bus) -> None:
    bus.sample(1)
    assert bus.loop.to_read(bus.at_s)
    bus.read()
    bus.sample(2)
    first, second = bus.bins
    assert np.isnan(first["sp"]) and first["mode"] == UNKNOWN_MODE and not first["gains"]
    assert second["sp"] == np.float32(50.1) and second["mode"] == Mode.AUTOMATIC
    assert bus.loop.rings.rows(T0, bus.at_s, 10).sets == (ONE,)
    assert not bus.loop.to_read(bus.at_s)


def test_they_are_unknown_again_after_a_gap_and_are_read_again(bus: Bus) -> None:
    bus.sample(1)
    bus.read()
    bus.sample(2)
    bus.sample(5)
    assert np.isnan(bus.bins["sp"][-1]) and not bus.bins["gains"][-1] and bus.loop.to_read(bus.at_s)


def test_a_status_tells_set_point_and_mode_but_no_gains(bus: Bus) -> None:
    bus.sample(1)
    bus.status(51.0, Mode.MANUAL)
    bus.sample(2)
    assert (bus.bins["sp"][-1], bus.bins["mode"][-1], bus.bins["gains"][-1]) == (51.0, Mode.MANUAL, 0)


def test_a_reading_that_was_overtaken_is_dropped(bus: Bus) -> None:
    bus.sample(1)
    began_s = bus.at_s
    bus.at_s += 0.05
    bus.status(52.0)
    bus.loop.learn(replace(FOUND, began_s=began_s), bus.at_s + 0.05)
    bus.sample(2)
    assert bus.bins["sp"][-1] == 52.0 and bus.loop.to_read(bus.at_s)
    began_s = bus.at_s
    bus.sample(9)  # a gap while the loop was being read
    bus.loop.learn(replace(FOUND, began_s=began_s), bus.at_s)
    bus.sample(10)
    assert np.isnan(bus.bins["sp"][-1]) and bus.loop.to_read(bus.at_s)


def test_a_trial_and_the_end_of_a_session_ask_for_the_gains_anew(bus: Bus) -> None:
    bus.sample(1)
    bus.read()
    for n, changed in enumerate(({"is_open": True}, {"is_open": True, "on_trial": True}, {}), 2):
        bus.status(50.1, **changed)
        bus.sample(n)
        assert not bus.bins["gains"][-1] and bus.loop.to_read(bus.at_s)
        if changed.get("on_trial"):
            bus.read()  # of before the trial: the job has not noted it yet
            assert bus.loop.to_read(bus.at_s)
        bus.read(on_trial=bool(changed.get("on_trial")))
        assert not bus.loop.to_read(bus.at_s)
    bus.status(53.0)  # an operator's set-point leaves the gains as they are
    bus.sample(5)
    assert bus.bins["gains"][-1] and bus.bins["sp"][-1] == 53.0


def test_gains_that_another_tuner_tries_stay_unknown_without_reading_for_ever(bus: Bus) -> None:
    bus.sample(1)
    bus.read(on_trial=True, gains=None)
    bus.sample(2)
    assert not bus.bins["gains"][-1] and bus.bins["sp"][-1] == np.float32(50.1) and not bus.loop.to_read(bus.at_s)


def test_a_loop_is_read_again_every_minute_while_it_is_heard(bus: Bus) -> None:
    bus.sample(1)
    bus.read()
    for n in range(2, 64):
        assert not bus.loop.to_read(bus.at_s) or bus.at_s - T0 > READ_AGAIN_S
        bus.sample(n, seconds=1.0)
    assert bus.loop.to_read(bus.at_s)
    assert not bus.loop.to_read(bus.at_s + 10 * SILENCE_S), "what is not heard is not asked"


def test_gains_as_computed_and_as_the_controller_holds_them_are_one_set(bus: Bus) -> None:
    bus.sample(1)
    bus.read(gains=(54.71810336887276, *ONE[1:]))
    bus.sample(2)
    bus.read(gains=(float(np.float32(54.71810336887276)), *ONE[1:]))
    bus.sample(3)
    found = bus.loop.rings.rows(T0, bus.at_s, 10)
    assert len(found.sets) == 1 and found.bins["gains"].tolist() == [0, 1, 1]
