"""Writes the Grafana dashboard beside it: python tools/monitoring/dashboard.py"""

from __future__ import annotations

from pathlib import Path

from grafana_foundation_sdk.builders.dashboard import Dashboard, Row
from grafana_foundation_sdk.builders.prometheus import Dataquery
from grafana_foundation_sdk.builders.stat import Panel as Stat
from grafana_foundation_sdk.builders.timeseries import Panel as TimeSeries
from grafana_foundation_sdk.cog.encoder import JSONEncoder

FILE = Path(__file__).with_name("dashboard.json")
Panels = tuple[tuple[str, str, str, str], ...]
"""Title, unit, expression and legend of each panel."""
NOW: Panels = (
    ("Loops", "short", "sum(loopwright_loops)", ""),
    ("Loops not confirmed restored", "short", "sum(loopwright_loops_restore_unconfirmed)", ""),
    ("Alarms of the highest priority", "short", 'sum(loopwright_alarms{priority="1"})', ""),
    ("Tests that run", "short", 'sum(loopwright_jobs{state="running"})', ""),
    ("Proposals that wait", "short", "sum(loopwright_proposals_waiting)", ""),
    ("Buses that are heard", "short", "sum(loopwright_listening_up)", ""),
)
LOOPS: Panels = (
    ("Jobs by state", "short", "sum by (state) (loopwright_jobs)", "{{state}}"),
    ("Alarms by priority", "short", "sum by (priority) (loopwright_alarms)", "priority {{priority}}"),
    ("Frames received", "cps", "sum by (bus) (rate(loopwright_frames_received_total[5m]))", "{{bus}}"),
    ("Samples lost in tests", "short", "sum by (bus) (increase(loopwright_samples_lost_total[5m]))", "{{bus}}"),
    ("SDO requests sent again", "short", "sum by (bus) (increase(loopwright_sdo_retries_total[5m]))", "{{bus}}"),
    (
        "Plant time of stages, median", "s",
        "histogram_quantile(0.5, sum by (stage, le) (rate(loopwright_stage_plant_seconds_bucket[1h])))", "{{stage}}",
    ),
)  # fmt: skip
SERVICE: Panels = (
    ("Requests", "reqps", "sum by (status) (rate(loopwright_http_requests_total[5m]))", "{{status}}"),
    (
        "Time of answers, 95 %", "s",
        "histogram_quantile(0.95, sum by (le) (rate(loopwright_http_request_seconds_bucket[5m])))", "p95",
    ),
    ("Requests being answered", "short", "loopwright_http_requests_in_flight", "{{instance}}"),
    ("Event loop late, worst of a minute", "s", "loopwright_event_loop_late_worst_seconds", "{{instance}}"),
    ("The database answers", "short", "loopwright_database_up", "{{instance}}"),
    ("Starts of the listening process", "short", "increase(loopwright_listener_restarts_total[1h])", "{{instance}}"),
)  # fmt: skip


def dashboard() -> Dashboard:
    """The dashboard: what is now, the loops, the service."""
    made = (
        Dashboard("Loopwright").uid("loopwright").tags(["loopwright"]).refresh("30s").time("now-6h", "now")
        .description("Loops, their tests, and the service. Alerts: alerts.yml beside this file.").readonly()
    )  # fmt: skip
    for title, unit, expression, _ in NOW:
        query = Dataquery().expr(expression).instant()
        made.with_panel(Stat().title(title).unit(unit).height(4).span(4).with_target(query))
    for row, panels in (("Loops", LOOPS), ("The service", SERVICE)):
        made.with_row(Row(row))
        for title, unit, expression, legend in panels:
            query = Dataquery().expr(expression).legend_format(legend)
            made.with_panel(TimeSeries().title(title).unit(unit).height(8).span(8).with_target(query))
    return made


def text() -> str:
    """The dashboard as Grafana imports it."""
    return JSONEncoder(sort_keys=True, indent=2).encode(dashboard().build()) + "\n"


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
