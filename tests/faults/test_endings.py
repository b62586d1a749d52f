"""A quick part of the table of faults (`make faults`), on live processes: how job and loop must end."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import Any

import pytest

from loopwright.protocol.profile import Mode
from tests.faults import campaign, report
from tests.faults.ending import Glance, unsafe
from tests.faults.injections import senseless_frames
from tests.faults.stand import HOME, PACE, Missing, Needs, Stand
from tests.faults.watch_cases import ALL_FAULTS
from tests.faults.watch_ending import OUTSIDE, WATCHED, WRITING

pytestmark = pytest.mark.timeout(200)

PROPOSED = "proposed None"
SILENT = ("failed node_lost", "failed samples_lost", "failed session_ended_by_device")
EXPECTED: dict[tuple[str, str], tuple[str, ...]] = {
    ("service-killed", "zn_pi"): (PROPOSED,),
    ("service-killed", "manual-up"): (PROPOSED,),
    ("plant-killed", "ultimate"): ("failed node_lost", "failed samples_lost"),
    ("controller-killed", "verify"): ("failed node_lost",),
    ("bus-down-0.1", "verify"): (PROPOSED, "failed samples_lost"),
    ("bus-down-1", "zn_pi"): SILENT,
    ("bus-down-1", "manual-up"): SILENT,
    ("bus-down-10", "baseline"): ("failed node_lost", "failed restore_unconfirmed"),
    ("lost-1", "verify"): (PROPOSED, *SILENT),
    ("lost-10", "verify"): (PROPOSED, *SILENT),
    ("late-0.1", "verify"): (PROPOSED,),
    ("late-5", "verify"): ("failed node_not_answering", "failed restore_unconfirmed"),
    ("twice", "verify"): (PROPOSED,),
    ("foreign-gains", "baseline"): ("aborted gains_changed",),
    ("foreign-gains", "setpoint-pulses"): ("aborted gains_changed",),
    ("foreign-gains", "verify"): ("aborted gains_changed",),
    ("foreign-setpoint", "setpoint-verify"): ("aborted setpoint_changed",),
    ("foreign-output", "manual-back"): ("aborted output_changed",),
    ("load", "manual-rest"): ("failed pv_limit",),
    ("load", "manual-up"): ("failed pv_limit",),
    ("defect", "manual-back"): ("failed internal",),
    ("deaf-listener", "verify"): (PROPOSED,),
    ("deaf-listener", "setpoint-pulses"): (PROPOSED,),
    ("clients", "ultimate"): ("aborted operator",),
    ("killed-twice", "relay"): (PROPOSED, "aborted operator"),
    ("killed-twice", "setpoint-pulses"): (PROPOSED, "aborted operator"),
    ("off-1", "relay"): ("aborted mode_changed",),
    ("off-10", "verify"): ("aborted mode_changed",),
    ("off-40", "verify"): ("aborted mode_changed",),
    ("off-40", "setpoint-pulses"): ("aborted mode_changed",),
    ("off-way-out", "fast-relay"): ("aborted operator", "aborted mode_changed"),
    ("pre-operational", "fast-relay"): ("failed node_not_operational",),
    ("pre-operational", "manual-rest"): ("failed node_not_operational",),
    ("pv-gone", "fast-relay"): ("failed bad_sample",),
    ("two-tuners", "fast-relay"): (PROPOSED,),
    ("second-gateway", "verify"): (PROPOSED,),
    ("disk-full", "zn_pi"): (PROPOSED,),
    ("clock-back", "zn_pi"): (PROPOSED,),
}
"""By fault and stage: state and reason of the job."""


class Stands:
    """One stand at a time: its five processes take the processor's time also while another one is looked at."""

    def __init__(self, folders: pytest.TempPathFactory) -> None:
        self._folders = folders
        self._stack = ExitStack()
        self._stand: tuple[Needs, Stand] | None = None

    def with_needs(self, needs: Needs) -> Stand:
        if self._stand is None or self._stand[0] != needs:
            self.close()
            try:
                self._stand = needs, Stand(self._stack, self._folders.mktemp("stand"), needs=needs)
            except Missing as missing:
                assert not os.environ.get("CI"), f"the tests need {missing}"
                pytest.skip(f"needs {missing}; `make faults` fails without")
        return self._stand[1]

    def close(self) -> None:
        self._stand = None
        self._stack.close()


@pytest.fixture(scope="module")
def stands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stands]:
    with closing(Stands(tmp_path_factory)) as stands:
        yield stands


@pytest.mark.parametrize(("fault", "stage"), EXPECTED)
def test_the_loop_ends_safe_and_the_job_says_why(fault: str, stage: str, stands: Stands) -> None:
    one = campaign.calm_ending(stands.with_needs(ALL_FAULTS[fault].needs), fault, stage)
    assert not one.bad, str(one)
    assert f"{one.state} {one.reason}" in EXPECTED[fault, stage], str(one)
    assert one.kept > 0
    assert (one.attempts > 1) == (fault in ("service-killed", "killed-twice", "second-gateway"))
    if one.state == "proposed" and one.attempts == 1:
        assert one.lost == 0, one


PUT_BACK, NOT_PUT_BACK = "rolled_back", "accepted"
WATCHED_ENDS = {
    ("watch-none", WATCHED): (PUT_BACK,),
    ("watch-service-killed", OUTSIDE): (PUT_BACK,),
    ("watch-service-killed", WRITING): (PUT_BACK, NOT_PUT_BACK),
    ("watch-bus-down-10", WRITING): (NOT_PUT_BACK,),
    ("watch-other-gains", OUTSIDE): (NOT_PUT_BACK,),
    ("watch-mode-twice", WATCHED): (NOT_PUT_BACK,),
}
"""By fault and moment: the state of the job whose gains were accepted."""


@pytest.mark.parametrize(("fault", "moment"), WATCHED_ENDS)
def test_a_watched_loop_never_has_gains_that_nobody_decided_on(fault: str, moment: str, stands: Stands) -> None:
    one = campaign.calm_ending(stands.with_needs(ALL_FAULTS[fault].needs), fault, moment)
    assert not one.bad, str(one)
    assert one.state in WATCHED_ENDS[fault, moment], one


def test_frames_that_make_no_sense_are_passed_over(stands: Stands) -> None:
    stand = stands.with_needs(Needs())
    stand.at_rest(PACE)
    with senseless_frames(stand, ""):
        before = stand.site.read("sample_number")
        assert stand.site.is_home() and stand.site.state().pv == pytest.approx(HOME.sp, abs=2e-3)
        time.sleep(0.2)
        assert stand.site.read("sample_number") > before


WELL: dict[str, Any] = {
    "at": 0.0, "mode": 2, "sp": HOME.sp, "on_trial": False, "session": 0, "Kp": HOME.Kp, "Ti": HOME.Ti, "mv": 50.2,
    "plant_mv": 50.0, "manual_output": 30.0, "safe_output": 0.0, "states": (5, 5),
}  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [
        {"mode": 3}, {"mode": 1}, {"sp": 50.1}, {"manual_output": 31.0}, {"on_trial": True}, {"session": 5},
        {"Kp": 40.0}, {"Ti": 2.4}, {"plant_mv": 60.0}, {"states": (127, 5)}, {"states": (5, 4)},
    ],
    ids=str,
)  # fmt: skip
def test_what_is_unsafe(change: dict[str, Any]) -> None:
    home = replace(HOME, output=30.0)
    assert unsafe(Glance(**WELL), home, at_rest=True) == ""
    assert unsafe(Glance(**WELL | change), home, at_rest=True)
    assert unsafe(None, HOME)


@pytest.mark.parametrize(("mode", "mv"), [(Mode.OFF, 0.0), (Mode.MANUAL, 30.0)], ids=str)
def test_in_off_and_manual_mv_is_what_they_stand_for(mode: Mode, mv: float) -> None:
    home = replace(HOME, mode=mode)
    assert unsafe(Glance(**WELL | {"mode": mode, "plant_mv": mv}), home) == ""
    assert "MV is 50.0" in unsafe(Glance(**WELL | {"mode": mode}), home)


def test_the_page_is_that_of_the_results() -> None:
    entries = campaign.load()
    assert report.TABLE.read_text(encoding="utf-8") == report.text(entries)
    assert {(entry["fault"], entry["stage"], entry["database"]) for entry in entries} == {
        (name, stage, database) for name, fault in ALL_FAULTS.items() for database, stage in fault.runs()
    }
    assert "0 unsafe endings" in report.text(entries)
