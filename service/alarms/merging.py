"""The alarms of all gateways of a database as one list, in which each is once. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from loopwright.service.alarms.alarm import Alarm, AlarmKind
from loopwright.service.alarms.conditions import AlarmFacts

_KNOWN_EVERYWHERE = frozenset(
    {
        AlarmKind.NOT_RESTORED,
        AlarmKind.FALSE_PV,
        AlarmKind.SUSPECT_GAINS,
        AlarmKind.ROLLED_BACK,
        AlarmKind.MODEL_MISMATCH,
        AlarmKind.TEST_FAILED,
        AlarmKind.GATEWAY_OFFLINE,
    }
)
"""Kinds that every gateway finds in the database by itself."""


def only_known_here(alarms: Iterable[Alarm], host: str) -> list[Alarm]:
    """Returns the alarms that the gateway `host` alone can know, which it has to say to the others."""
    return [alarm for alarm in alarms if alarm.gateway == host and alarm.kind not in _KNOWN_EVERYWHERE]


def merged(own: Iterable[Alarm], known: AlarmFacts) -> list[Alarm]:
    """Returns the alarms seen here and those that the other gateways have said, the worst first.

    What a gateway has said last stays until it counts as one that does not answer: from then on nothing is known.
    """
    found = {alarm.id: alarm for alarm in own if alarm.id not in known.acknowledged}
    silent = {alarm.gateway for alarm in found.values() if alarm.kind is AlarmKind.GATEWAY_OFFLINE}
    for gateway in known.gateways:
        for alarm in gateway.alarms:
            if gateway.name not in silent and alarm.id not in known.acknowledged:
                found.setdefault(alarm.id, alarm)
    return sorted(found.values(), key=lambda alarm: (alarm.priority, alarm.subject, alarm.kind, alarm.id))
