"""What a gateway says of its loops to those that share its database, as JSON in its row of the table `gateways`."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel, TypeAdapter

from loopwright.service.alarms.alarm import Alarm
from loopwright.service.jobs.active_job import Running
from loopwright.service.live.messages import BusView, LoopValues
from loopwright.service.results import GainsView
from loopwright.service.states.loop_state import LoopState


class JobProgress(BaseModel):
    """How far a running job has come. Times are plant time unless they are called wall time, s."""

    id: str
    stage: str | None
    progress: float
    remaining_plant_time_s: float | None
    remaining_wall_time_s: float | None = None
    plant_time_s: float
    stopping: bool


def progress_of(running: Running) -> JobProgress:
    """Returns how far a job of this service has come."""
    now, pace = running.progress_now(), running.pace()
    remaining_s = now.remaining_s
    return JobProgress(
        id=running.job_id,
        stage=now.stage,
        progress=round(now.fraction, 4),
        remaining_plant_time_s=None if remaining_s is None else round(remaining_s, 1),
        remaining_wall_time_s=None if remaining_s is None or pace is None else round(remaining_s / pace, 1),
        plant_time_s=round(now.plant_time_s, 1),
        stopping=running.stop_reason is not None,
    )


class Present(BaseModel):
    """What changes all the time. Ages of samples are those at the time of writing. alarms: those that the others
    cannot find in the database by themselves."""

    loops: list[LoopValues]
    buses: list[BusView]
    jobs: list[JobProgress]
    alarms: list[Alarm] = []


class LoopSettings(BaseModel):
    """What was read of a loop's controller last, as far as its process data do not carry it."""

    gains: GainsView
    mv_low: float
    mv_high: float
    sample_time_s: float
    reverse_acting: bool
    node_state: str
    fail_action: str

    @classmethod
    def of(cls, state: LoopState) -> LoopSettings:
        return cls(
            gains=GainsView.of(state.gains),
            mv_low=state.mv_low,
            mv_high=state.mv_high,
            sample_time_s=state.sample_time_s,
            reverse_acting=state.reverse_acting,
            node_state=state.node_state,
            fail_action=state.fail_action,
        )


SETTINGS: TypeAdapter[Mapping[str, LoopSettings]] = TypeAdapter(Mapping[str, LoopSettings])
"""Reads and writes the settings by tag."""
