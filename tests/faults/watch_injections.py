"""What others do to a loop that is watched after an acceptance; contexts as in `tests.faults.injections`."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import replace

from loopwright.protocol.profile import Mode, ParameterCommand
from tests.faults.injections import Harm
from tests.faults.stand import Stand

AWAY_S = 10.0
MANUAL_S = 5.0
OTHERS = (40.0, 2.4)
"""Kp and Ti that somebody else has decided on."""


@contextmanager
def nothing(stand: Stand, url: str) -> Harm:
    yield None


@contextmanager
def controller_away(stand: Stand, url: str) -> Harm:
    stand.site.controller.kill()
    time.sleep(AWAY_S)
    stand.site.start_controller()
    stand.site.controller.wait_ready()
    yield None


@contextmanager
def other_gains(stand: Stand, url: str) -> Harm:
    for name, value in zip(("controller_staged_kp", "controller_staged_ti"), OTHERS, strict=True):
        stand.site.write(name, value)
    for command in (ParameterCommand.TRY, ParameterCommand.ACCEPT):
        stand.site.write("controller_parameter_command", command)
    yield replace(stand.home, Kp=OTHERS[0], Ti=OTHERS[1], words="on their gains")


@contextmanager
def gains_on_trial(stand: Stand, url: str) -> Harm:
    """Taken back when the watch has decided."""
    stand.site.write("controller_staged_kp", OTHERS[0])
    stand.site.write("controller_parameter_command", ParameterCommand.TRY)
    yield None
    stand.site.write("controller_parameter_command", ParameterCommand.GO_BACK)


@contextmanager
def manual_for_a_while(stand: Stand, url: str) -> Harm:
    stand.site.write("controller_mode_command", Mode.MANUAL)
    time.sleep(MANUAL_S)
    stand.site.write("controller_mode_command", Mode.AUTOMATIC)
    yield None


@contextmanager
def rolled_back(stand: Stand, url: str) -> Harm:
    """By a person, at the same moment."""
    answer = stand.site.http.post(f"{url}/rollback", json={"by": "A. Lind"})
    if answer.status_code not in (200, 409):
        stand.defects.append(f"POST {url}/rollback: {answer.status_code} {answer.text}")
    yield None
