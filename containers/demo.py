"""The demo of docker-compose.yml: one HTTP call retunes the loop; what happens is shown live, then the proof.

The exit status is 0 for a proposal, 3 if the retune ended otherwise, 1 if there was no answer. A retune that is running
already, for example one that was resumed after a restart, is followed instead of starting another.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from loopwright.service.cli import job_tables
from loopwright.service.cli.client import ApiError, Client

URL = "http://127.0.0.1:8080"


def main() -> int:
    try:
        return _demonstrate(Client(URL))
    except ApiError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1


def _demonstrate(client: Client) -> int:
    started = time.monotonic()
    loop = client.get("/loops")[0]
    if url := loop["active_job"]:
        job_tables.console.print(f"GET   {url}: a retune is on its way", highlight=False)
    else:
        url = client.post(f"/loops/{loop['tag']}/retune", {"requested_by": "demo"})["url"]
        job_tables.console.print(f"POST  /loops/{loop['tag']}/retune -> {url}", highlight=False)
    job = job_tables.follow(client, url)
    job_tables.job_report(job, loop["pv_unit"])
    proof = _proof(job, client.get(f"/loops/{loop['tag']}"), time.monotonic() - started)
    job_tables.console.print("\n".join(proof), highlight=False, soft_wrap=True)
    return 0 if job["state"] == "proposed" else 3


def _proof(job: dict[str, Any], loop: dict[str, Any], seconds: float) -> list[str]:
    live = loop["live"]
    # fast measures one step under the new gains, to verify the model that predicts both responses
    how, names = "measured", (("overshoot", "overshoot_pct", " %"), ("IAE", "IAE", f" {loop['pv_unit']} s"))
    before, after = job["before"], job["after"]
    if before is None:
        how, names = "predicted", (("overshoot", "overshoot_pct", " %"), ("Ms", "Ms", ""))
        before, after = job["predicted_before"], job["predicted"]
    changes = [
        f"{label} {job_tables.cell((before or {}).get(name))} -> {job_tables.cell((after or {}).get(name))}{unit}"
        for label, name, unit in names
    ]
    if job["verification"]:
        changes.append(f"{job['verification']['fit_pct']:.1f} % of the measured step explained")
    held = ", ".join(f"{name} {job_tables.cell(live['gains'][name])}" for name in ("Kp", "Ti"))
    held = f"{held}, set-point {job_tables.cell(live['sp'])}"
    return [
        f"proof       {how}: {', '.join(changes)}",
        f"controller  {live['mode']}, {held}: its own until a proposal is accepted",
        f"time        {job['plant_time_s']:.0f} s of plant time in {seconds:.1f} s",
        f"state       {job['state']}",
    ]


if __name__ == "__main__":
    sys.exit(main())
