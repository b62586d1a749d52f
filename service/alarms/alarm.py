"""An alarm, and the closed list of its kinds, each with priority and delays."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Priority = Literal[1, 2, 3]
PRIORITIES: tuple[Priority, ...] = (1, 2, 3)


class AlarmKind(StrEnum):
    """The value is what the API shows and the database holds."""

    NOT_RESTORED = "not_restored"
    FALSE_PV = "false_pv"
    BUS_DOWN = "bus_down"
    NODE_LOST = "node_lost"
    NODE_NOT_OPERATIONAL = "node_not_operational"
    NO_DATA = "no_data"
    PV_OUTSIDE_LIMITS = "pv_outside_limits"
    FOREIGN_TEST = "foreign_test"
    GATEWAY_OFFLINE = "gateway_offline"
    SUSPECT_GAINS = "suspect_gains"
    ROLLED_BACK = "rolled_back"
    MODEL_MISMATCH = "model_mismatch"
    TEST_FAILED = "test_failed"
    GAINS_DIFFER = "gains_differ"


@dataclass(frozen=True)
class KindRule:
    """How alarms of a kind come and go.

    priority: 1 is the worst.
    on_s, off_s: on-delay and off-delay, s.
    to_acknowledge: whether a person may acknowledge it; an alarm that goes with its condition needs nobody.
    """

    priority: Priority
    on_s: float
    off_s: float
    to_acknowledge: bool


RULES: dict[AlarmKind, KindRule] = {
    AlarmKind.NOT_RESTORED: KindRule(1, 0.0, 0.0, True),
    AlarmKind.FALSE_PV: KindRule(1, 0.0, 0.0, True),
    AlarmKind.BUS_DOWN: KindRule(2, 3.0, 3.0, False),
    AlarmKind.NODE_LOST: KindRule(2, 3.0, 3.0, False),
    AlarmKind.NODE_NOT_OPERATIONAL: KindRule(2, 3.0, 3.0, False),
    AlarmKind.NO_DATA: KindRule(2, 3.0, 3.0, False),
    AlarmKind.PV_OUTSIDE_LIMITS: KindRule(2, 3.0, 3.0, False),
    AlarmKind.FOREIGN_TEST: KindRule(2, 5.0, 3.0, False),
    AlarmKind.GATEWAY_OFFLINE: KindRule(2, 10.0, 3.0, False),
    AlarmKind.SUSPECT_GAINS: KindRule(1, 0.0, 0.0, True),
    AlarmKind.ROLLED_BACK: KindRule(2, 0.0, 0.0, True),
    AlarmKind.MODEL_MISMATCH: KindRule(2, 0.0, 0.0, True),
    AlarmKind.TEST_FAILED: KindRule(3, 0.0, 0.0, True),
    AlarmKind.GAINS_DIFFER: KindRule(3, 0.0, 0.0, True),
}


class Acknowledgement(BaseModel):
    """Who has acknowledged an alarm."""

    model_config = ConfigDict(frozen=True)

    by: str = Field(description="Who has acknowledged it, as given in the request", examples=["operator A"])
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])


class Alarm(BaseModel):
    """An alarm."""

    model_config = ConfigDict(frozen=True)

    id: str = Field(description="The same on every gateway, and as long as the alarm lasts", examples=["0f3ac2d9be11"])
    priority: Priority = Field(description="1: look now, and acknowledge; 2: soon; 3: when there is time")
    kind: AlarmKind
    subject: str = Field(
        description="The loop, the bus, the node or the gateway", examples=["TIC-101", "node 20h on socketcan:can0"]
    )
    text: str = Field(description="What is wrong", examples=["PV is above its limit of 51 degC"])
    advice: str = Field(description="What the operator should do")
    since: str = Field(description="When it began: UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    gateway: str = Field(description="Name of the gateway that has the loop or the bus", examples=["local"])
    loop: str | None = Field(
        description="Tag of the loop; null: it is about a bus, a node or a gateway", examples=["TIC-101"]
    )
    loops: list[str] = Field(description="Tags of all loops that it concerns", examples=[["TIC-101"]])
    job: str | None = Field(description="URL of the test that it is about", examples=["/jobs/4f0c2a9be113"])
    unacknowledged: bool = Field(
        description="Whether it waits to be acknowledged; one that does not goes by itself when its cause is gone"
    )
    acknowledged: Acknowledgement | None = Field(description="Who has acknowledged it, and when; null: nobody has")


class AlarmList(BaseModel):
    """The active alarms, the worst first."""

    alarms: list[Alarm]
