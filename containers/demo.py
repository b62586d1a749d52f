"""The demo of docker-compose.yml: each method retunes the loop through HTTP, shown live; then a table compares them.

Then it ends, and the other containers go on: it sets the plant to real time and names the page of the loop. The exit
status is 0 if every retune ended as a proposal, 3 if one ended otherwise, 2 for a method that there is not, 1 if there
was no answer. A retune that is running already, for example one that was resumed after a restart, is followed instead
of starting others.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from loopwright.containers import keeper
from loopwright.protocol.tuner import TunerError
from loopwright.service.api.job_views import LoopView
from loopwright.service.cli import demo_live, demo_report
from loopwright.service.cli.client import ApiError, Client

URL = "http://127.0.0.1:8080"
_JOIN_S = 5.0


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="demo", description="Retunes the loop of docker-compose.yml by each method.")
    parser.add_argument("--method", choices=demo_report.METHODS, help="one of them alone")
    parser.add_argument("--once", action="store_true", help="leave the plant at its speed, and name no page")
    options = parser.parse_args(argv)
    methods = [options.method] if options.method else demo_report.METHODS
    try:
        return _demonstrate(Client(URL), methods, options.once)
    except (ApiError, TunerError, keeper.NoBus, OSError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1


def _demonstrate(client: Client, methods: Sequence[str], once: bool) -> int:
    loop = LoopView.model_validate(client.pages("/loops")[0])
    # Another speed than max is that of whoever runs the containers, and stays.
    at_full_speed = os.environ.get("LOOPWRIGHT_SPEED", "max") == "max"
    if at_full_speed and loop.active_job is None:
        _set_pace(demo_live.FULL_SPEED)  # an earlier demo has left it in real time
    shown = demo_report.demonstrate(client, loop.tag, methods)
    plant = os.environ.get("LOOPWRIGHT_MODEL", demo_report.PLANT)
    known = plant == demo_report.PLANT
    demo_report.report(client, loop.tag, shown, demo_report.PLANT_MODEL if known else None)
    if not known:
        print(f"The demo knows {demo_report.PLANT} and not {plant}: without Ms, overshoot and IAE on the true plant.")
    if not once:
        if at_full_speed:
            _set_pace(demo_live.REAL_TIME)
        _name_page(loop.tag, shown)
    return 3 if shown.without_proposal else 0


def _set_pace(pace: float) -> None:
    url, connection = keeper.join(_JOIN_S)
    with connection:
        demo_live.set_pace(url, pace)


def _name_page(tag: str, shown: demo_report.Demonstration) -> None:
    url = f"http://127.0.0.1:{os.environ.get('LOOPWRIGHT_PORT', '8080')}"
    print(demo_live.page_line(url, tag, "on the machine with the containers, while they run"))
    if (proposal := demo_live.latest_proposal(shown.jobs)) is not None:
        command = ["docker", "compose", "exec", "service", "loopwright", "job", proposal.id, "--accept"]
        print(demo_live.accept_line(command, proposal))
    print("end              Ctrl-C where docker compose up runs, else docker compose stop", flush=True)


if __name__ == "__main__":
    sys.exit(main())
