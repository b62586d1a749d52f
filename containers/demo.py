"""The demo of docker-compose.yml: one HTTP call retunes the loop; what happens is shown live, then the proof.

The exit status is 0 for a proposal, 3 if the retune ended otherwise, 1 if there was no answer. A retune that is running
already, for example one that was resumed after a restart, is followed instead of starting another.
"""

from __future__ import annotations

import sys
import time

from pydantic import BaseModel

from loopwright.service.api.job_views import JobView, LoopDetail, LoopView
from loopwright.service.cli import job_tables
from loopwright.service.cli.client import ApiError, Client
from loopwright.service.job_states import JobState

URL = "http://127.0.0.1:8080"


def main() -> int:
    try:
        return _demonstrate(Client(URL))
    except ApiError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1


def _demonstrate(client: Client) -> int:
    started = time.monotonic()
    loop = LoopView.model_validate(client.pages("/loops")[0])
    if url := loop.active_job:
        job_tables.console.print(f"GET   {url}: a retune is on its way", highlight=False)
    else:
        begun = JobView.model_validate(client.post(f"/loops/{loop.tag}/retune", {"requested_by": "demo"}))
        url = begun.url
        job_tables.console.print(f"POST  /loops/{loop.tag}/retune -> {url}", highlight=False)
    job = job_tables.follow(client, url)
    job_tables.job_report(job, loop.pv_unit)
    now = LoopDetail.model_validate(client.get(f"/loops/{loop.tag}"))
    proof = _proof(job, now, time.monotonic() - started)
    job_tables.console.print("\n".join(proof), highlight=False, soft_wrap=True)
    return 0 if job.state is JobState.PROPOSED else 3


def _proof(job: JobView, loop: LoopDetail, seconds: float) -> list[str]:
    live = loop.live
    assert live is not None  # its bus is this host's, and the job has just ended
    # fast measures one step, under the new gains, to verify the model that predicts both responses
    how, names = "measured", (("overshoot", "overshoot_pct", " %"), ("IAE", "IAE", f" {loop.pv_unit} s"))
    before: BaseModel | None = job.before
    after: BaseModel | None = job.after
    if before is None:
        how, names = "predicted", (("overshoot", "overshoot_pct", " %"), ("Ms", "Ms", ""))
        before, after = job.predicted_before, job.predicted
    changes = [
        f"{label} {job_tables.figure(before, name)} -> {job_tables.figure(after, name)}{unit}"
        for label, name, unit in names
    ]
    if job.verification:
        changes.append(f"{job.verification.fit_pct:.1f} % of the measured step explained")
    held = ", ".join(f"{name} {job_tables.figure(live.gains, name)}" for name in ("Kp", "Ti"))
    held = f"{held}, set-point {job_tables.cell(live.sp)}"
    return [
        f"proof       {how}: {', '.join(changes)}",
        f"controller  {live.mode}, {held}: its own until a proposal is accepted",
        f"time        {job.plant_time_s:.0f} s of plant time in {seconds:.1f} s",
        f"state       {job.state}",
    ]


if __name__ == "__main__":
    sys.exit(main())
