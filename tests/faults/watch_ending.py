"""A fault while a loop is watched after an acceptance, or while the watch puts the previous gains back: how it ends.

What goes wrong under the new gains is a load that MV cannot balance: PV leaves its limits for good.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from loopwright.protocol.profile import Mode, ParameterCommand
from loopwright.protocol.real32 import same
from tests.faults.ending import Ending, Glance, Home, unsafe
from tests.faults.injections import Injection
from tests.faults.stand import HOME, LOOP, PACE, Stand

WATCHED, OUTSIDE, WRITING = "watched", "outside", "writing"
MOMENTS = {
    WATCHED: "before anything goes wrong, which it does as soon as the fault has struck",
    OUTSIDE: "PV has been outside its limits for a second, of the three that the watch waits",
    WRITING: "the watch has opened its session to write the previous gains",
}
LOAD_PCT = 200.0
OUTSIDE_S = 1.0
SEEN_WITHIN_S = 30.0
SETTLED_WITHIN_S = 45.0
HOME_WITHIN_S = 20.0
DESIGNED: dict[str, Any] = {
    "method": "fast", "start": "design", "model": {"num": [0.03, 0.02], "den": [3.0, 4.0, 1.0], "dead_time_s": 1.0},
    "verify": False, "propose_anyway": True, "excitations": ["relay"],
}  # fmt: skip
"""A proposal without a test: the model of the loop is given."""


def watch_ending(stand: Stand, name: str, inject: Injection, moment: str, database: str) -> Ending:
    """One fault at one moment of the watch."""
    began = time.monotonic()
    stand.at_rest(PACE)
    url = _accepted(stand)
    new = replace(HOME, Kp=stand.site.read("controller_accepted_kp"), Ti=stand.site.read("controller_accepted_ti"))
    # a fault that changes something by hand says how the loop is then, but for the gains that the watch decides on
    stand.home = new
    if moment != WATCHED:
        _go_wrong(stand)
        if moment == WRITING:
            _until(lambda: stand.hub.session_opened, SEEN_WITHIN_S, "the watch opens a session")
        else:
            time.sleep(OUTSIDE_S)
    struck = time.monotonic()
    with inject(stand, url) as other:
        if moment == WATCHED:
            _go_wrong(stand)
        job = _settled(stand, url, other)
    stand.site.write("plant_disturbance", 0.0)
    seen = stand.eye.settled(_end(stand.eye.glance(), new, other, job), HOME_WITHIN_S)
    home = _end(seen, new, other, job)
    bad = unsafe(seen, home, at_rest=True)
    defects = [*stand.defects, *_contradictions(stand, job, other)]
    _home_again(stand)
    watch = job["monitoring"]
    put_back = watch["trouble"] is not None and watch["trouble"]["rolled_back"]
    why = watch["auto_rollback_off"] if watch["trouble"] is None else watch["trouble"]["reason"]
    return Ending(
        database, name, moment, job["state"], "rolled_back" if put_back else watch["end"], why and _undated(why), 1,
        round(time.monotonic() - struck, 1), 0, 0, 0, bad, home.words, defects,
        round(time.monotonic() - began, 1), round(stand.stalls.longest_s, 2),
    )  # fmt: skip


def _accepted(stand: Stand) -> str:
    """The URL of a job whose gains were accepted, and whose loop is heard and within its limits."""
    url = stand.site.retune(**DESIGNED)
    job = stand.site.finished(url)
    assert job["state"] == "proposed", job
    answer = stand.site.http.post(f"{url}/accept", json={"by": "A. Lind"})
    assert answer.status_code == 200, answer.text
    stand.hub.new_job()
    _until(lambda: stand.site.job(url)["monitoring"]["no_data"] is None, SEEN_WITHIN_S, "the loop is heard")
    time.sleep(2.0)  # of wall time: the watch looks once a second, and is to have seen PV within its limits
    return url


def _go_wrong(stand: Stand) -> None:
    """A load, set past every fault of the bus, takes PV out of its limits."""
    stand.eye.write("plant_disturbance", LOAD_PCT)
    low, high = LOOP.pv_limits
    _until(lambda: not low <= stand.eye.read("plant_pv") <= high, SEEN_WITHIN_S, "PV leaves its limits")


def _settled(stand: Stand, url: str, other: Home | None) -> dict[str, Any]:
    """The job when the watch has decided, has ended or is auto_rollback_off for good, or as it is when nothing of it
    comes."""
    give_up = time.monotonic() + SETTLED_WITHIN_S
    while True:
        job = stand.site.job(url)
        trouble = job["monitoring"]["trouble"]
        decided = trouble is not None and trouble["rolled_back"] is not None
        if (
            decided
            or job["monitoring"]["end"] is not None
            or (_out_of_automatic(other) and job["monitoring"]["auto_rollback_off"])
        ):
            return stand.site.job(url)
        if time.monotonic() > give_up:
            return job
        time.sleep(0.1)


def _out_of_automatic(other: Home | None) -> bool:
    """Whether somebody has left the loop in another mode: where PV goes then is not for the watch."""
    return other is not None and other.mode is not Mode.AUTOMATIC


def _end(seen: Glance | None, new: Home, other: Home | None, job: dict[str, Any]) -> Home:
    """How the loop must be: on the previous gains where they were put back, else on those that it had.

    new: with the accepted gains.  other: as somebody else has left it meanwhile, whose word on gains is the last one.
    """
    trouble = job["monitoring"]["trouble"]
    if other is not None and other.Kp != new.Kp:
        return other
    if job["state"] == "rolled_back":
        words = "the previous gains" if other is None else f"the previous gains, {other.words}"
        return replace(other or new, Kp=HOME.Kp, Ti=HOME.Ti, words=words)
    if other is not None:
        return other
    in_doubt = trouble is not None and trouble["reason"] is not None and "read the loop" in trouble["reason"]
    if in_doubt and seen is not None and same(seen.Kp, HOME.Kp):
        return replace(HOME, words="the previous gains, in doubt")
    return replace(new, words="the new gains, in doubt" if in_doubt else "the new gains")


def _contradictions(stand: Stand, job: dict[str, Any], other: Home | None) -> list[str]:
    """What the service says of the end, and does not agree."""
    watch, found = job["monitoring"], []
    trouble = watch["trouble"]
    if trouble is None:
        seen = watch["end"] is not None or (_out_of_automatic(other) and watch["auto_rollback_off"] is not None)
        return [] if seen else ["the watch has seen nothing"]
    if trouble["rolled_back"] is None:
        found.append("the watch has not decided")
    if bool(trouble["rolled_back"]) != (job["state"] == "rolled_back"):
        found.append(f"rolled_back is {trouble['rolled_back']}, and the job {job['state']}")
    kind = "rolled_back" if trouble["rolled_back"] else "suspect_gains"
    try:
        _until(lambda: kind in _alarms(stand), SEEN_WITHIN_S, f"the alarm {kind}")
    except AssertionError as error:
        found.append(str(error))
    return found


def _undated(why: str) -> str:
    """Without the time of day, which is another in each run."""
    return re.sub(r" at \d{4}-\S+", "", why)


def _alarms(stand: Stand) -> set[str]:
    answer = stand.site.http.get("/alarms")
    return {each["kind"] for each in answer.json()} if answer.status_code == 200 else set()


def _home_again(stand: Stand) -> None:
    """The previous gains, by hand, for the next run."""
    for name, value in (("controller_staged_kp", LOOP.kp), ("controller_staged_ti", LOOP.ti)):
        stand.site.write(name, value)
    for command in (ParameterCommand.TRY, ParameterCommand.ACCEPT):
        stand.site.write("controller_parameter_command", command)


def _until(seen: Callable[[], bool], within_s: float, words: str) -> None:
    give_up = time.monotonic() + within_s
    while not seen():
        assert time.monotonic() < give_up, f"not within {within_s:g} s: {words}"
        time.sleep(0.02)
