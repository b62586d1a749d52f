"""The counters of this process. `api.metrics` shows them together with figures from the store."""

from __future__ import annotations

from prometheus_client import Counter, Gauge, Histogram, disable_created_metrics

disable_created_metrics()  # type: ignore[no-untyped-call]

SAMPLES_LOST = Counter("loopwright_samples_lost", "Samples that did not arrive during a test", ["bus"], registry=None)
STAGE_SECONDS = Histogram(
    "loopwright_stage_plant_seconds",
    "Plant time of a finished stage, s",
    ["stage"],
    buckets=(1, 3, 10, 30, 100, 300, 1000, 3000, 10_000, 30_000),
    registry=None,
)
REQUESTS = Counter("loopwright_http_requests", "Answered requests", ["method", "route", "status"], registry=None)
REQUEST_SECONDS = Histogram(
    "loopwright_http_request_seconds",
    "Wall time to the end of an answer, s; event streams left out",
    ["route"],
    buckets=(0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10),
    registry=None,
)
IN_FLIGHT = Gauge("loopwright_http_requests_in_flight", "Requests being answered", registry=None)
LATE_SECONDS = Histogram(
    "loopwright_event_loop_late_seconds",
    "Lateness of the event loop when it resumes a task, s",
    buckets=(0.001, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 3),
    registry=None,
)
LATEST_SECONDS = Gauge(
    "loopwright_event_loop_late_worst_seconds",
    "Largest lateness of the event loop in the last minute, s",
    registry=None,
)

CLOCK_JUMPS = Counter(
    "loopwright_clock_jumps", "Jumps of the wall clock that were seen; the ages of samples count from the last one",
    registry=None,
)  # fmt: skip

FRAMES_RECEIVED = Counter(
    "loopwright_frames_received", "Frames of process data received for the history", ["bus"], registry=None
)
LISTENING_UP = Gauge(
    "loopwright_listening_up", "1: the process data of the bus is heard for the history", ["bus"], registry=None
)
LISTENER_RESTARTS = Counter(
    "loopwright_listener_restarts", "Starts of the listening process after it had died", registry=None
)
HISTORY_BLOCKS_LOST = Counter(
    "loopwright_history_blocks_lost", "Blocks of history that the database did not take in time", registry=None
)

WEBHOOK_ATTEMPTS = Counter(
    "loopwright_webhook_attempts", "Attempts to deliver a message to a webhook", ["webhook", "outcome"], registry=None
)
WEBHOOKS_WAITING = Gauge(
    "loopwright_webhook_messages_waiting", "Messages not yet delivered to the webhook", ["webhook"], registry=None
)

OF_THIS_PROCESS = (
    SAMPLES_LOST, STAGE_SECONDS, REQUESTS, REQUEST_SECONDS, IN_FLIGHT, LATE_SECONDS, LATEST_SECONDS, CLOCK_JUMPS,
    FRAMES_RECEIVED, LISTENING_UP, LISTENER_RESTARTS, HISTORY_BLOCKS_LOST,
    WEBHOOK_ATTEMPTS, WEBHOOKS_WAITING,
)  # fmt: skip
