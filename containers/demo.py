"""The demo of docker-compose.yml: each method retunes the loop through HTTP, shown live; then a table compares them.

The exit status is 0 if every retune ended as a proposal, 3 if one ended otherwise, 2 for a method that there is not, 1
if there was no answer. A retune that is running already, for example one that was resumed after a restart, is followed
instead of starting others.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from loopwright.service.api.job_views import LoopView
from loopwright.service.cli import demo_report
from loopwright.service.cli.client import ApiError, Client

URL = "http://127.0.0.1:8080"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="demo", description="Retunes the loop of docker-compose.yml by each method.")
    parser.add_argument("--method", choices=demo_report.METHODS, help="one of them alone")
    method = parser.parse_args(argv).method
    try:
        return _demonstrate(Client(URL), [method] if method else demo_report.METHODS)
    except ApiError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1


def _demonstrate(client: Client, methods: Sequence[str]) -> int:
    tag = LoopView.model_validate(client.pages("/loops")[0]).tag
    shown = demo_report.demonstrate(client, tag, methods)
    plant = os.environ.get("LOOPWRIGHT_MODEL", demo_report.PLANT)
    known = plant == demo_report.PLANT
    demo_report.report(client, tag, shown, demo_report.PLANT_MODEL if known else None)
    if not known:
        print(f"The demo knows {demo_report.PLANT} and not {plant}: without Ms, overshoot and IAE on the true plant.")
    return 3 if shown.without_proposal else 0


if __name__ == "__main__":
    sys.exit(main())
