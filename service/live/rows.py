"""What the messages say of loops: from what was heard, from the running job, from the jobs. Pure: time is handed in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.protocol.profile import Mode
from loopwright.service.listening.bins import Bins, decimals
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.live.messages import LastJob, LiveLoopRow, LoopValues, OldValues, Samples
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.live_jobs import JobInBrief

_MODES = {mode.value: mode.name.lower() for mode in Mode}


@dataclass(frozen=True)
class LiveFacts:
    """What is known of a loop beside its name.

    heard: what was heard last; None: nothing.
    deaf: why its bus is not heard; None: it is.
    held: the state that the running job of this service has; None: no such job has read the loop.
    job, last_job: the job that has the loop, and the latest one.
    locked_since: since when somebody has locked the loop; None: it is not locked.
    """

    heard: Heard | None = None
    deaf: str | None = None
    held: LoopState | None = None
    job: JobInBrief | None = None
    last_job: JobInBrief | None = None
    locked_since: str | None = None


def loop_row(tag: str, host: str, known: LiveFacts, now_s: float) -> LiveLoopRow:
    """Returns the row of a loop of this host."""
    return with_jobs(loop_values(tag, known, now_s), host, known.job, known.last_job, known.locked_since)


def with_jobs(
    values: LoopValues, host: str, job: JobInBrief | None, last_job: JobInBrief | None, locked_since: str | None = None
) -> LiveLoopRow:
    """Returns the row of a loop with these values."""
    return LiveLoopRow(
        **dict(values),
        gateway=host,
        job=None if job is None else f"/jobs/{job.id}",
        last_job=None if last_job is None else LastJob(url=f"/jobs/{last_job.id}", state=last_job.state),
        locked_since=locked_since,
    )


def loop_values(tag: str, known: LiveFacts, now_s: float) -> LoopValues:
    """Returns the values of a loop. Old ones are set apart; where a bus is not heard, the running job's count."""
    heard, held = known.heard, known.held
    age_s = None if heard is None else max(0.0, now_s - heard.at_s)
    row = no_values(tag, None, age_s)
    if heard is not None and not heard.silent:
        row.pv, row.sp, row.mv, row.mode = _values(heard)
        row.under_test, row.on_trial = heard.session, heard.on_trial
    elif held is not None and known.deaf is not None:
        row.pv, row.sp, row.mv = (_finite(value) for value in (held.pv, held.sp, held.mv))
        row.mode, row.on_trial = held.mode.name.lower(), held.on_trial
    else:
        row.no_data = known.deaf or ("no sample has come yet" if age_s is None else f"no data for {age_s:.0f} s")
        if heard is not None:
            pv, sp, mv, mode = _values(heard)
            row.last = OldValues(pv=pv, sp=sp, mv=mv, mode=mode)
    if row.under_test is None and held is not None:
        row.under_test = True
    return row


def no_values(tag: str, no_data: str | None, age_s: float | None, last: OldValues | None = None) -> LoopValues:
    """Returns the values of a loop whose present ones are not known. age_s, last: of its last sample."""
    return LoopValues(
        tag=tag, pv=None, sp=None, mv=None, mode=None, age_s=None if age_s is None else round(age_s, 3),
        under_test=None, on_trial=None, no_data=no_data, last=last,
    )  # fmt: skip


def old(values: LoopValues) -> OldValues | None:
    """Returns the values that are still known when these are no longer present ones; None: there are none."""
    if values.no_data is not None:
        return values.last
    return OldValues(pv=values.pv, sp=values.sp, mv=values.mv, mode=values.mode)


def samples_message(tag: str, bins: Bins, past: bool) -> Samples:
    """Returns bins as columns: a bin of one sample is that sample; one of several has the time of its last and the
    means."""
    at_s: list[float] = np.round(bins["until_s"], 3).tolist()
    return Samples(
        tag=tag,
        past=past,
        n=bins["n"].tolist(),
        at_s=at_s,
        sp=decimals(bins, "sp"),
        pv=decimals(bins, "pv_mean"),
        mv=decimals(bins, "mv_mean"),
        mode=[mode if mode in _MODES else None for mode in bins["mode"].tolist()],
        gap_before=np.flatnonzero(bins["gap"]).tolist(),
    )


def _values(heard: Heard) -> tuple[float | None, float | None, float | None, str | None]:
    """Returns PV, set-point, MV and mode."""
    return _finite(heard.pv), _finite(heard.sp), _finite(heard.mv), _MODES.get(heard.mode)


def _finite(value: float) -> float | None:
    """Returns the shortest decimals of a REAL32; None for what is no number."""
    return float(str(np.float32(value))) if math.isfinite(value) else None
