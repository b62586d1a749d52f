"""What is abnormal at one moment, from what is known then. Pure: time is handed in, the delays are in delays.py.

A cause is said once: where a bus is down or a node is lost, its loops are named with it and have no alarm of their own
for want of data. No text has a number that changes while nothing else does: a screen shows each change.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from loopwright.protocol.profile import Mode, NmtState, node_name
from loopwright.service.alarms.alarm import RULES, Alarm, AlarmKind
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.listening.heard_node import HeardHeartbeat
from loopwright.service.states.acceptance_watch import AcceptanceWatch, Trouble, TroubleKind, instead_in_words
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import LoopState, loop_state, same_gains
from loopwright.service.store.alarms import NOT_RESTORED_TEXT, FalsePvJob, UnconfirmedJob, alarm_id
from loopwright.service.store.live_jobs import Acceptance, JobInBrief
from loopwright.service.store.watches import WatchWithAlarm
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode as PlanMode
from loopwright.tuning.reasons import ADVICE, Reason

_NEVER_HEARD_OF_T95 = 0.2
"""A loop that can be tuned is sampled at least fifty times a period: three samples take less than this part of T95."""
_NO_ANSWER = (JobState.FAILED, JobState.INTERRUPTED)
_BUS_ADVICE = (
    "Check the interface and the cable. The bus is opened again every 2 s; controllers whose tests ran on it "
    "restore their loops by themselves."
)
_LISTENING_ADVICE = "It is started again by itself. Tests go on; what the loops do is not seen until then."
_GATEWAY_ADVICE = f"{ADVICE[Reason.GATEWAY_LOST]} What alarms there are there is not known here meanwhile."
_SEE_THE_JOB = "See the job."
_WHEN_PV_IS_RIGHT = (
    "Check the sensor, and control the loop by hand; when PV is right again, acknowledge this and put it in automatic."
)
_UNTIL_ACKNOWLEDGED = "It stays until somebody acknowledges it."


@dataclass(frozen=True)
class BusFacts:
    """A bus of this gateway that is listened to.

    why: why it is not heard; None: it is.
    up_s: since when it has been heard, wall time, s.
    """

    url: str
    why: str | None
    up_s: float


@dataclass(frozen=True)
class LoopFacts:
    """A loop of this gateway.

    heard: what was heard of it last; None: nothing.
    held: its state in the running job of this gateway, if any; it counts where the bus is not listened to.
    job: id of the active job that has it, on whatever gateway.
    gains: those read last, and when that reading began, wall time, s; None: they are not known.
    accepted: the acceptance in force.
    """

    config: LoopConfig
    heard: Heard | None = None
    held: LoopState | None = None
    job: str | None = None
    gains: tuple[Gains, float] | None = None
    accepted: Acceptance | None = None


@dataclass(frozen=True)
class GatewayFacts:
    """Another gateway of the database, with at least one loop.

    last_s: when it was last there, wall time, s; None: never.
    silent: whether it should have been there again since.
    waited_from_s: since when the database, by which it is seen, has answered without a break, wall time, s.
    alarms: what it has said last of what only it can know.
    """

    name: str
    last_s: float | None
    silent: bool
    waited_from_s: float
    loops: tuple[str, ...]
    alarms: Sequence[Alarm] = ()


@dataclass(frozen=True)
class AlarmFacts:
    """What is known at one moment.

    host: the name of this gateway.
    nodes: the heartbeats heard last, by bus and node.
    gateways: the other gateways of the database.
    tests: the latest job of each loop of every gateway.
    unconfirmed: tests of every gateway after which the loop was not confirmed to be as before.
    false_pvs: tests of every gateway that have found PV to be false.
    watches: those after acceptances, of every gateway, that have found something.
    acknowledged: ids of alarms that were acknowledged, of those in `to_be_asked`.
    """

    host: str
    buses: Sequence[BusFacts] = ()
    loops: Sequence[LoopFacts] = ()
    nodes: Mapping[tuple[str, int], HeardHeartbeat] = field(default_factory=dict)
    gateways: Sequence[GatewayFacts] = ()
    tests: Sequence[JobInBrief] = ()
    unconfirmed: Sequence[UnconfirmedJob] = ()
    false_pvs: Sequence[FalsePvJob] = ()
    watches: Sequence[WatchWithAlarm] = ()
    acknowledged: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Condition:
    """Something that is abnormal at this moment.

    since_s: when it began, wall time, s; None: when it was seen first.
    from_s: from when the on-delay counts, wall time, s; None: from when it was seen first.
    on_s: the on-delay, s; None: that of the kind.
    """

    id: str
    kind: AlarmKind
    subject: str
    text: str
    advice: str
    host: str
    loop: str | None = None
    loops: tuple[str, ...] = ()
    job: str | None = None
    since_s: float | None = None
    from_s: float | None = None
    on_s: float | None = None


def conditions(known: AlarmFacts) -> list[Condition]:
    """Returns everything that is abnormal at the moment of which this is known, each once."""
    found = [*_tests(known), *_watches(known), *_gateways(known), *_buses(known), *_nodes(known)]
    explained = {tag for each in found if each.loop is None for tag in each.loops}
    up_s = {bus.url: bus.up_s for bus in known.buses if bus.why is None}
    for loop in known.loops:
        found += _of_loop(known.host, loop, up_s.get(loop.config.bus), loop.config.tag in explained)
    return [each for each in found if each.id not in known.acknowledged]


def to_be_asked(known: AlarmFacts) -> set[str]:
    """Returns the ids of the alarms of which it matters here whether they were acknowledged."""
    ended = {each for test in known.tests if test.state in _NO_ANSWER for each in _of_the_end(test.id)}
    theirs = {alarm.id for gateway in known.gateways for alarm in gateway.alarms if alarm.unacknowledged}
    return ended | theirs | {each.id for each in conditions(known) if RULES[each.kind].to_acknowledge}


def _tests(known: AlarmFacts) -> Iterator[Condition]:
    """What remains of tests that have ended."""
    unconfirmed = {job.id for job in known.unconfirmed} | {job.id for job in known.false_pvs}
    for found in known.false_pvs:
        text, advice = _false_pv(found)
        yield Condition(
            alarm_id(AlarmKind.FALSE_PV, found.id), AlarmKind.FALSE_PV, found.loop, text,
            f"{advice} No test begins until somebody acknowledges this.", found.host, found.loop, (found.loop,),
            f"/jobs/{found.id}", _seconds(found.at),
        )  # fmt: skip
    for job in known.unconfirmed:
        text = NOT_RESTORED_TEXT
        if job.monitored:
            advice = (
                "Look at the controller now. It is looked at again until the loop is as before. " + _UNTIL_ACKNOWLEDGED
            )
            if job.reason is not Reason.RESTORE_UNCONFIRMED:
                advice = "Look at the controller now. It is looked at again until the loop is as before."
        else:
            advice = "The loop was read back later, or a later test has begun on it. " + _UNTIL_ACKNOWLEDGED
        yield Condition(
            alarm_id(AlarmKind.NOT_RESTORED, job.id), AlarmKind.NOT_RESTORED, job.loop, text, advice, job.host,
            job.loop, (job.loop,), f"/jobs/{job.id}", _seconds(job.at),
        )  # fmt: skip
    for test in known.tests:
        if test.state not in _NO_ANSWER or test.id in unconfirmed:
            continue
        # whoever acknowledged that has seen how the test ended
        if not known.acknowledged.isdisjoint(_of_the_end(test.id)):
            continue
        how = "failed" if test.state is JobState.FAILED else "was interrupted"
        why = "" if test.reason is None else f": {str(test.reason).replace('_', ' ')}"
        # A later version may have written a word that is not in the list.
        advice = _SEE_THE_JOB if test.reason is None else ADVICE.get(test.reason, _SEE_THE_JOB)
        yield Condition(
            alarm_id(AlarmKind.TEST_FAILED, test.id), AlarmKind.TEST_FAILED, test.loop, f"The last test {how}{why}",
            advice, test.host, test.loop, (test.loop,), f"/jobs/{test.id}", _seconds(test.at),
        )  # fmt: skip


def _of_the_end(job_id: str) -> set[str]:
    """Returns the ids of the alarms that say more of the end of a test than that it failed."""
    return {alarm_id(kind, job_id) for kind in (AlarmKind.NOT_RESTORED, AlarmKind.FALSE_PV)}


def _false_pv(job: FalsePvJob) -> tuple[str, str]:
    """Returns what was found and what the loop was left in, and what is to be done."""
    found = "PV was found to be false in a test"
    if job.restored is None:
        text = f"{found}; the loop could not be read back"
        return text, f"Look at the loop now: it may be in automatic on this PV. Put it in manual. {_WHEN_PV_IS_RIGHT}"
    state = loop_state(job.restored)
    text = f"{found}; the loop was left in {state.mode.name.lower()}"
    if state.mode is PlanMode.AUTOMATIC:
        return text, f"Look at the loop now: unless somebody has put it in manual, do that. {_WHEN_PV_IS_RIGHT}"
    return f"{text} at MV {state.held_mv:.6g} %", _WHEN_PV_IS_RIGHT


def _watches(known: AlarmFacts) -> Iterator[Condition]:
    """What was found after acceptances."""
    for each in known.watches:
        trouble, job = each.watch.trouble, f"/jobs/{each.job_id}"
        if trouble is None:
            kind, since_s = AlarmKind.MODEL_MISMATCH, None
            text, advice = _mismatch(each.watch), "Roll the new gains back, or retune the loop. " + _UNTIL_ACKNOWLEDGED
        elif trouble.kind is TroubleKind.FALSE_PV:
            kind, since_s, text = AlarmKind.FALSE_PV, _seconds(trouble.at), f"PV is false. {trouble.text}"
            advice = (
                "Look at the sensor and the loop now: it is in automatic on this PV unless you put it in manual. "
                f"Nothing was written to it, and monitoring puts no gains back. {_UNTIL_ACKNOWLEDGED}"
            )
        elif trouble.rolled_back:
            kind, since_s = AlarmKind.ROLLED_BACK, _seconds(trouble.at)
            text = f"The previous gains were put back automatically: {trouble.text}"
            advice = (
                f"Look at the loop, and at what was found of the model, before it is retuned. {_UNTIL_ACKNOWLEDGED}"
            )
        else:
            kind, since_s = AlarmKind.SUSPECT_GAINS, _seconds(trouble.at)
            text = trouble.text
            advice = f"Look at the loop now, and roll the new gains back. {_why_not(trouble)} {_UNTIL_ACKNOWLEDGED}"
        yield Condition(
            alarm_id(kind, each.job_id), kind, each.loop, text, advice, each.host, each.loop, (each.loop,), job, since_s
        )


def _mismatch(watch: AcceptanceWatch) -> str:
    found = watch.conclusion().instead
    assert found is not None
    return f"The plant is not the one of the model: {instead_in_words(found)}"


def _why_not(trouble: Trouble) -> str:
    return "" if trouble.reason is None else f"They were not put back automatically: {trouble.reason}."


def _gateways(known: AlarmFacts) -> Iterator[Condition]:
    for gateway in known.gateways:
        if gateway.silent:
            waited_from_s = max(gateway.waited_from_s, gateway.last_s or 0.0)
            yield Condition(
                alarm_id(AlarmKind.GATEWAY_OFFLINE, gateway.name), AlarmKind.GATEWAY_OFFLINE, f"gateway {gateway.name}",
                f"Gateway {gateway.name} does not answer", _GATEWAY_ADVICE, gateway.name, loops=gateway.loops,
                since_s=gateway.last_s, from_s=waited_from_s,
            )  # fmt: skip


def _buses(known: AlarmFacts) -> Iterator[Condition]:
    for bus in known.buses:
        if bus.why is None:
            continue
        why = bus.why.replace(f"bus '{bus.url}' ", "it ", 1)
        text, advice = f"Bus {bus.url} is down: {why}", _BUS_ADVICE
        if bus.why.startswith("the listening process"):
            text, advice = f"No data of bus {bus.url}: {bus.why}", _LISTENING_ADVICE
        yield Condition(
            alarm_id(AlarmKind.BUS_DOWN, known.host, bus.url), AlarmKind.BUS_DOWN, bus.url, text, advice, known.host,
            loops=_tags(loop.config for loop in known.loops if loop.config.bus == bus.url),
        )  # fmt: skip


def _nodes(known: AlarmFacts) -> Iterator[Condition]:
    up_s = {bus.url: bus.up_s for bus in known.buses if bus.why is None}
    for (url, node), heard in sorted(known.nodes.items()):
        loops = _tags(
            loop.config
            for loop in known.loops
            if loop.config.bus == url and node in (loop.config.controller_node, loop.config.plant_node)
        )
        if url not in up_s or not loops:
            continue
        subject = f"node {node:02X}h on {url}"
        if heard.silent:
            yield Condition(
                alarm_id(AlarmKind.NODE_LOST, known.host, url, str(node)), AlarmKind.NODE_LOST, subject,
                f"Node {node_name(node)} is lost: its heartbeat has stopped", ADVICE[Reason.NODE_LOST], known.host,
                loops=loops, since_s=heard.at_s, from_s=max(heard.at_s, up_s[url]),
            )  # fmt: skip
        elif heard.state in (NmtState.PRE_OPERATIONAL, NmtState.STOPPED):
            state = heard.state.name.lower().replace("_", "-")
            yield Condition(
                alarm_id(AlarmKind.NODE_NOT_OPERATIONAL, known.host, url, str(node)), AlarmKind.NODE_NOT_OPERATIONAL,
                subject, f"Node {node_name(node)} is {state}: it controls nothing",
                "Start the node (NMT) and look at its loops. Loopwright sends no NMT command.", known.host, loops=loops,
            )  # fmt: skip


def _of_loop(host: str, loop: LoopFacts, up_s: float | None, explained: bool) -> Iterator[Condition]:
    """up_s: since when the bus is heard; None: it is not, or not listened to."""
    heard, config = loop.heard, loop.config
    if up_s is not None and not explained:
        yield from _no_data(host, loop, up_s)
    if heard is not None and not heard.silent and up_s is not None:
        pv, on_trial = heard.pv, bool(heard.on_trial)
        under_test = bool(heard.session) or heard.mode == Mode.EXPERIMENT
    elif loop.held is not None and up_s is None:
        pv, on_trial, under_test = loop.held.pv, loop.held.on_trial, True
    else:
        pv, on_trial, under_test = math.nan, False, False
    yield from _pv(host, config, pv)
    if (on_trial or under_test) and loop.job is None:
        yield _condition(
            AlarmKind.FOREIGN_TEST, host, config,
            "Gains are on trial that no job here has begun" if on_trial else "A test runs that no job here has begun",
            "Ask who works on the loop: another tuner, or somebody at the controller.",
        )  # fmt: skip
    yield from _gains(host, loop)


def _no_data(host: str, loop: LoopFacts, up_s: float) -> Iterator[Condition]:
    heard, config = loop.heard, loop.config
    advice = "Check power and cable of controller and plant I/O, and that both nodes are operational."
    if heard is None:
        patience_s = max(3.0, _NEVER_HEARD_OF_T95 * config.t95_s)
        text = "No data since the bus is up"
        yield _condition(AlarmKind.NO_DATA, host, config, text, advice, since_s=up_s, from_s=up_s, on_s=patience_s)
    elif heard.silent:
        from_s = max(heard.at_s, up_s)
        yield _condition(AlarmKind.NO_DATA, host, config, "No data", advice, since_s=heard.at_s, from_s=from_s)


def _pv(host: str, config: LoopConfig, pv: float) -> Iterator[Condition]:
    """A PV that is no number is within no limits and outside none."""
    limits = config.pv_limits
    for side, limit, outside in (("below", limits.low, pv < limits.low), ("above", limits.high, pv > limits.high)):
        if outside:
            text = f"PV is {side} its limit of {limit:g} {config.pv_unit}"
            advice = "Look at the loop: what moves PV? No test begins outside the limits."
            yield _condition(AlarmKind.PV_OUTSIDE_LIMITS, host, config, text, advice)


def _gains(host: str, loop: LoopFacts) -> Iterator[Condition]:
    """A reading from before the acceptance tells nothing of what the controller has since."""
    if loop.gains is None or loop.accepted is None or loop.job is not None:
        return
    (gains, read_s), accepted = loop.gains, loop.accepted
    if read_s < _seconds(accepted.at) or same_gains(gains, accepted.gains):
        return
    yield Condition(
        alarm_id(AlarmKind.GAINS_DIFFER, loop.config.tag, accepted.job_id, repr(gains)), AlarmKind.GAINS_DIFFER,
        loop.config.tag,
        f"The gains differ from those accepted last: {_words(gains)} instead of {_words(accepted.gains)}",
        "If they are meant to, acknowledge this. Else retune the loop, or put the accepted gains back.",
        host, loop.config.tag, (loop.config.tag,), f"/jobs/{accepted.job_id}",
    )  # fmt: skip


def _condition(
    kind: AlarmKind,
    host: str,
    config: LoopConfig,
    text: str,
    advice: str,
    *,
    since_s: float | None = None,
    from_s: float | None = None,
    on_s: float | None = None,
) -> Condition:
    tag = config.tag
    return Condition(
        alarm_id(kind, tag), kind, tag, text, advice, host, tag, (tag,), None, since_s, from_s, on_s
    )  # fmt: skip


def _tags(configs: Iterable[LoopConfig]) -> tuple[str, ...]:
    return tuple(sorted(config.tag for config in configs))


def _words(gains: Gains) -> str:
    td = f", Td {gains.Td:.4g} s" if gains.Td else ""
    b = f", b {gains.b:.3g}" if gains.b != 1.0 else ""
    return f"Kp {gains.Kp:.4g}, Ti {gains.Ti:.4g} s{td}{b}"


def _seconds(at: str) -> float:
    """Returns the seconds since 1970 of a time as the database has it."""
    return datetime.fromisoformat(at).timestamp()
