"""Rows and samples: what is not known is null, what is old is left out, a gap stays a gap."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from loopwright.service.listening.bins import GAP_BEFORE, SAMPLE, UNKNOWN_MODE, of_samples
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.live.messages import OldValues
from loopwright.service.live.rows import LiveFacts, loop_row, samples_message
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.live_jobs import JobInBrief
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode

T0 = 1_769_860_800.0
HEARD = Heard(T0, False, float(np.float32(49.9)), float(np.float32(41.2)), 50.0, 2, False, True)
JOB = JobInBrief(
    "4f0c2a9be113",
    "A",
    "local",
    JobState.RUNNING,
    False,
    "A. Lind",
    "relay",
    3.0,
    False,
    None,
    "2026-01-31T12:00:00.000Z",
)
HELD = LoopState(Mode.EXPERIMENT, 50.5, 49.0, math.nan, Gains(1.0, 2.0), True, 0.0, 100.0, 0.1, True)


def test_a_loop_that_is_heard() -> None:
    row = loop_row("A", "local", LiveFacts(HEARD, job=JOB, last_job=JOB), T0 + 0.06)
    assert (row.pv, row.sp, row.mv, row.mode, row.age_s) == (49.9, 50.0, 41.2, "automatic", 0.06)
    assert (row.under_test, row.on_trial, row.no_data, row.job) == (True, False, None, "/jobs/4f0c2a9be113")
    assert row.last_job is not None and row.last_job.state is JobState.RUNNING
    assert row.locked_since is None
    assert loop_row("A", "local", LiveFacts(HEARD, locked_since="2026-01-31T12:00:00.000Z"), T0).locked_since


def test_what_is_not_known_is_null() -> None:
    unknown = replace(HEARD, pv=math.nan, sp=math.nan, mv=math.inf, mode=UNKNOWN_MODE, on_trial=None, session=None)
    row = loop_row("A", "local", LiveFacts(unknown), T0 - 5.0)
    assert row.pv is row.sp is row.mv is row.mode is row.under_test is row.on_trial is row.job is row.last_job is None
    assert row.age_s == 0.0, "a clock that was put back makes no negative age"
    row = loop_row("A", "local", LiveFacts(), T0)
    assert row.pv is row.age_s is None and row.no_data == "no sample has come yet"


def test_what_is_old_is_set_apart_with_its_age() -> None:
    row = loop_row("A", "local", LiveFacts(replace(HEARD, silent=True), held=HELD), T0 + 12.4)
    assert row.pv is row.sp is row.mv is row.mode is row.on_trial is None
    assert (row.age_s, row.no_data) == (12.4, "no data for 12 s")
    assert row.last == OldValues(pv=49.9, sp=50.0, mv=41.2, mode="automatic")
    assert loop_row("A", "local", LiveFacts(HEARD), T0).last is None


def test_where_a_bus_is_not_heard_the_running_job_knows_the_loop() -> None:
    deaf = "a bus of the kind slcan cannot be opened by a second process"
    row = loop_row("A", "local", LiveFacts(deaf=deaf, held=HELD, job=JOB), T0)
    assert (row.pv, row.sp, row.mv, row.mode, row.on_trial) == (49.0, 50.5, None, "experiment", True)
    assert row.under_test is True and row.no_data is None and row.age_s is None
    assert loop_row("A", "local", LiveFacts(deaf=deaf), T0).no_data == deaf


def test_samples_are_columns_with_their_gaps() -> None:
    rows = np.zeros(3, SAMPLE)
    rows["at_s"], rows["n"] = [T0, T0 + 0.1, T0 + 9.0], [7, 8, 1]
    rows["pv"], rows["mv"], rows["sp"] = [49.9, math.nan, 50.1], 40.0, [math.nan, 50.0, 50.0]
    rows["mode"], rows["gap"] = [UNKNOWN_MODE, 2, 3], [0, 0, GAP_BEFORE]
    message = samples_message("A", of_samples(rows), past=False)
    assert (message.n, message.at_s, message.gap_before) == ([7, 8, 1], [T0, T0 + 0.1, T0 + 9.0], [2])
    assert (message.pv, message.sp, message.mode) == ([49.9, None, 50.1], [None, 50.0, 50.0], [None, 2, 3])
