"""Invariants of every history, checked after every action of the controller and once more at the end.

The truth is recorded independently of the controller, from what people have done: home, and then the last outside
change. A controller without an open session must agree with the truth at every moment; with one, it must have noted the
truth as home.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from loopwright.controller.pid import Parameters
from loopwright.controller.relay import Relay
from loopwright.controller.session import Session
from loopwright.protocol.objects import Value
from loopwright.protocol.profile import (
    COMMAND_FRAME,
    Cause,
    Mode,
    NmtState,
    OnMissingAnswer,
    ParameterCommand,
    channel_ids,
)
from loopwright.protocol.real32 import same
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.jobs import Job
from tests.simulation.devices import Controller, PlantNode
from tests.simulation.disk import AGAIN_S, SOON_S
from tests.simulation.scheduler import START, Simulation
from tests.simulation.wire import State, Wire

_LIMITS = {
    "controller_mv_low", "controller_mv_high", "controller_safe_output", "controller_rate_limit", "controller_pv_low",
    "controller_pv_high", "controller_action",
}  # fmt: skip
_OF_HANDS = {
    "setpoint_changed": "set-point",
    "mode_changed": "mode",
    "output_changed": "output",
    "gains_changed": "gains",
    "limits_changed": "limits",
}


@dataclass
class Held:
    """What the controller held from a time on."""

    since: float
    mode: int
    sp: float
    output: float
    accepted: Parameters
    on_trial: bool
    session: int


@dataclass
class Truth:
    """What people have chosen last. trial: gains that a hand has put on trial.  output: manual output."""

    mode: Mode
    sp: float
    output: float
    accepted: Parameters
    trial: Parameters | None = None
    since: float = 0.0


@dataclass
class Bad:
    """A thing that must not be. at: s since the start."""

    at: float
    text: str


@dataclass
class Invariants:
    """Looks at one controller and its plant. permitted: gains that a person has asked for by accepting or rolling
    back."""

    simulation: Simulation
    wire: Wire
    controller: Controller
    plant: PlantNode
    permitted: list[Parameters] = field(default_factory=list)
    bad: list[Bad] = field(default_factory=list)
    held: list[Held] = field(default_factory=list)
    hands: list[tuple[float, str]] = field(default_factory=list)
    readings: dict[int, tuple[LoopState, float, float]] = field(default_factory=dict)
    holds: set[int] = field(default_factory=set)
    """The sessions in which HOLD was put in force."""
    on_hold: Callable[[], object] = lambda: None
    a_defect_is_put_in: bool = False

    def __post_init__(self) -> None:
        start = self.controller.start_values
        self.truth = Truth(Mode(start.mode), start.setpoint, start.manual_output, start.parameters)
        self.past: list[Truth] = [self.truth]
        self.off_at = 0.0
        self._session: Session | None = None
        self._last: Held | None = None
        self._rpdo: float | None = None
        self._held_mv: float | None = None
        self._good = 0
        self._open = (0, 0.0)
        self.controller.on_change = self.look
        self.controller.on_write = self._written
        self._hooked: object = None
        self._said: set[str] = set()
        self._bad_samples = 0
        self._bump: tuple[float, float | None, int] | None = None
        self._before: tuple[int, float | None, float] = 0, None, 0.0
        self._relay: Relay | None = None
        self._goes_on_from = 0.0
        """The output from which the next law, or a hand's MANUAL, goes on."""
        self._in_force: set[tuple[int, str, Value]] = set()
        self._home_mv = 0.0
        """Noted at the opening of the session."""

    # -- telling

    def say(self, text: str, key: str = "") -> None:
        key = key or text.split(":")[0]
        if key not in self._said:
            self._said.add(key)
            self.bad.append(Bad(self.simulation.now - START, text))
            self.simulation.note("BAD", text)

    # -- what people do

    def hand(self, what: str) -> None:
        self.hands.append((self.simulation.now, what))
        self.simulation.note("truth", f"outside change: {what}; {self.words()}")

    def words(self) -> str:
        truth = self.truth
        return f"{truth.mode.name.lower()}, SP {truth.sp:g}, output {truth.output:g}, Kp {truth.accepted.Kp:g}"

    def _change(self, **changed: Any) -> None:
        self.past = [each for each in self.past if each.since > self.simulation.now - 30.0] + [self.truth]
        values = {name: getattr(self.truth, name) for name in Truth.__dataclass_fields__}
        self.truth = Truth(**{**values, **changed, "since": self.simulation.now})

    def _written(self, name: str, value: Value, do: Callable[[], None]) -> None:
        """An SDO write to the controller, carried out by `do`."""
        session = self.controller.device.sessions[0]
        channel = session.channel
        relay, was_open, accepted = channel.relay, session.is_open, channel.accepted
        if name == "controller_parameter_command" and value == ParameterCommand.ACCEPT:
            self.permitted.append(channel.in_effect)  # its writing may be cut
        count = session.count
        do()
        if name.startswith("controller_order_") and session.count != count:
            order = session.number or session.last, name, value
            if order in self._in_force:
                self.say(f"put in force twice: {name} {value:08X}h")
            self._in_force.add(order)
            if name == "controller_order_hold":
                self._on_hold(session)
        number = float(value) if not isinstance(value, str) else math.nan
        if name == "controller_setpoint":
            self._change(sp=number)
            self.hand("set-point")
        elif name == "controller_manual_output":
            self._change(output=number)
            self.hand("output")
        elif name in ("controller_mode_command", "controller_on"):
            mode = Mode(int(number)) if name != "controller_on" else (Mode.AUTOMATIC if number else Mode.OFF)
            output = self.truth.output
            if mode is Mode.MANUAL and self.truth.mode is not Mode.MANUAL:
                settings = channel.settings
                output = self._goes_on_from if relay is None else relay.settings.working_output
                output = min(max(output, settings.mv_low), settings.mv_high)
            self._change(mode=mode, output=output)
            self.hand("mode")
        elif name in _LIMITS:
            self.hand("limits")
        elif name == "controller_parameter_command":
            if number == ParameterCommand.TRY:
                self._change(trial=channel.staged)
            elif number == ParameterCommand.GO_BACK:
                self._change(trial=None)
            else:
                chosen = accepted if was_open or self.truth.trial is None else self.truth.trial
                self._change(trial=None, accepted=chosen)
            self.hand("gains")
        elif name == "controller_order_accept" and channel.accepted != self.truth.accepted:
            if channel.accepted not in self.permitted:
                self.say(f"accepted without a person: {channel.accepted}")
            self._change(accepted=channel.accepted)
            self.hands.append((self.simulation.now, "gains"))

    def _on_hold(self, session: Session) -> None:
        """What is chosen from now on, unless somebody's hand chooses otherwise."""
        self.holds.add(session.number)
        self.on_hold()
        if not self.plant.sensor.was_false:
            self.say("HOLD under a true sensor")
        if self.truth.mode is Mode.AUTOMATIC:
            self._change(mode=Mode.MANUAL, output=self._home_mv)
        self.simulation.note("truth", f"HOLD; {self.words()}")

    def _on_command(self, data: bytes, do: Callable[[bytes], None]) -> None:
        session = self.controller.device.sessions[0]
        was_open, home = session.is_open, session.home.setpoint
        do(data)
        if len(data) != COMMAND_FRAME.size:
            return
        value = COMMAND_FRAME.unpack(data)[0]
        if not math.isfinite(value):
            return
        reference = home if self._rpdo is None else self._rpdo
        self._rpdo = value
        if was_open and value == reference:
            return
        if value != self.truth.sp or was_open:
            self._change(sp=value)
            self.hand("set-point")

    # -- the controller

    def power_on(self) -> None:
        """To be called as the controller is on again."""
        controller = self.controller
        self._rpdo = None
        start = controller.start_values
        if controller.keep and controller.disk.kept is not None:
            kept = controller.disk.kept[0]
            choices = [self.truth, *self.past]
            may_lag_s = SOON_S + 0.7 + (AGAIN_S + 0.5 if controller.disk.full_at > self.off_at - AGAIN_S - 0.5 else 0.0)
            recent = [c for c in choices if c is self.truth or c.since > self.off_at - may_lag_s]
            older = [c for c in choices if c.since <= self.off_at - may_lag_s]
            recent += sorted(older, key=lambda each: each.since)[-1:]
            if not any((kept.mode, kept.setpoint, kept.manual_output) == (c.mode, c.sp, c.output) for c in recent):
                self.say(f"kept over a restart: {kept}, chosen was {self.words()}")
            if kept.accepted != self.truth.accepted and kept.accepted not in self.permitted:
                self.say(f"gains kept over a restart: {kept.accepted}, accepted were {self.truth.accepted}")
            self._change(
                mode=kept.mode, sp=kept.setpoint, output=kept.manual_output, accepted=kept.accepted, trial=None
            )
        else:
            self._change(
                mode=Mode(start.mode), sp=start.setpoint, output=start.manual_output, accepted=start.parameters,
                trial=None,
            )  # fmt: skip
        self.hands.append((self.simulation.now, "restart"))

    def _hook(self) -> None:
        """The set-point's RPDO comes past here."""
        runtime = self.controller.device.runtime
        can_id = channel_ids(1, 0x10, self.controller.node).command
        handler = runtime.handlers[can_id]
        runtime.handlers[can_id] = lambda data: self._on_command(data, handler)
        runtime.gate()
        self._hooked = self.controller.device

    def look(self) -> None:
        """After everything the controller does."""
        device = self.controller.device
        if device is not self._hooked:
            self._hook()
            self._session = device.sessions[0]
            self._held_mv = self._last = self._bump = self._relay = None
        session = device.sessions[0]
        channel = session.channel
        if session is not self._session:
            self._reset(session)
        now = Held(
            self.simulation.now, channel.mode, channel.setpoint, channel.manual_output, channel.accepted,
            channel.on_trial, session.number,
        )  # fmt: skip
        last = self._last
        if channel.good_samples != self._before[0] or channel.pv is None:
            self._goes_on_from = channel.mv
        if self._relay is not None and channel.relay is None:  # until a sample comes, the present MV is its side
            self._goes_on_from = self._relay.settings.working_output
        if last is not None and last.session and not session.number:
            base = self._goes_on_from
            self._bump = base, channel.pv, channel.good_samples
            if self._before[0] != channel.good_samples:
                # Within a sample, or right after it: of these it is known that they end within one.
                in_sample = session.cause in (Cause.PV_LIMIT, Cause.RELAY_SAMPLES)
                self._bump = (base, self._before[1], self._before[0]) if in_sample else None
            if session.cause is Cause.OUTSIDE_CHANGE or session.outside_changes:
                self._bump = None
        if self._bump is not None and (self._bump[2] != channel.good_samples or session.outside_changes):
            self._no_bump(session, self._bump)
            self._bump = None
        self._before = channel.good_samples, channel.pv, channel.mv
        self._relay = channel.relay
        if self._held_mv is not None and (channel.good_samples != self._good or session.number):
            self._held_mv = None
        if last is not None and (
            last.mode == now.mode
            and last.sp == now.sp
            and last.session == now.session
            and last.output == now.output
            and last.on_trial == now.on_trial
            and last.accepted is now.accepted
        ):
            return
        self._last = now
        self.held.append(now)
        truth = self.truth
        if session.is_open:
            if last is None or last.session != session.number:
                self._open = session.number, self.simulation.now
                self._home_mv = session.home.mv
                if self.holds and not any(kind == "restart" for _, kind in self.hands):
                    self.say("a test begins on a loop whose PV was found to be false")
                words = f"session {session.number:08X}h of {session.holder:02X}h opens"
                self.simulation.note(self.controller.name, words)
            home = session.home
            pending = self._bump is not None and channel.pv is not None and channel.mode is Mode.AUTOMATIC
            if pending and not _near(home.mv, self._bump[0]):
                self.say(f"MV noted as home is {home.mv:g}, where {self._bump[0]:g} was to come after the last session")
            if (home.mode, home.setpoint, home.manual_output) != (truth.mode, truth.sp, truth.output):
                self.say(f"home noted is not what was chosen: {home}, chosen {self.words()}")
        else:
            if last is not None and last.session:
                self._ended(session)
            wrong = []
            if channel.mode != truth.mode:
                wrong.append(f"mode is {channel.mode.name}")
            if channel.setpoint != truth.sp:
                wrong.append(f"SP is {channel.setpoint:g}")
            if channel.manual_output != truth.output:
                wrong.append(f"manual output is {channel.manual_output:g}")
            if channel.on_trial != (truth.trial is not None):
                wrong.append(f"on trial is {channel.on_trial}")
            if channel.in_effect != (truth.trial or truth.accepted):
                wrong.append(f"in effect is {channel.in_effect}")
            if wrong:
                self.say(f"without a session: {', '.join(wrong)}; chosen was {self.words()}")
        if channel.accepted != truth.accepted:
            self.say(f"accepted gains: {channel.accepted}, chosen were {truth.accepted}")

    def _ended(self, session: Session) -> None:
        channel, home = session.channel, session.home
        self.simulation.note(
            self.controller.name,
            f"session {session.last:08X}h ends ({session.cause.name.lower()}), MV {channel.mv:.4g}, "
            f"PV {'valid' if session.pv_is_valid else 'not valid'}",
        )
        settings = channel.settings
        operational = self.controller.runtime.state is NmtState.OPERATIONAL
        if channel.mode is Mode.AUTOMATIC:
            wanted = min(max(home.mv, settings.mv_low), settings.mv_high)
            if (not session.pv_is_valid or session.cause is Cause.NMT) and channel.mv != wanted:
                self.say(f"MV without PV after the session: {channel.mv:g}, home's is {home.mv:g}")
            self._held_mv, self._good = wanted, channel.good_samples  # unless PV comes
        elif channel.mode is Mode.MANUAL and not (operational and session.pv_is_valid):
            wanted = min(max(channel.manual_output, settings.mv_low), settings.mv_high)
            if channel.mv != wanted:
                self.say(f"MV in manual without PV after the session: {channel.mv:g}, chosen is {wanted:g}")

    def _no_bump(self, session: Session, bump: tuple[float, float | None, int]) -> None:
        """The first sample after a session goes on from where MV, or the relay's working output, was."""
        channel, (base, pv, good) = session.channel, bump
        settings = channel.settings
        if (
            channel.mode is not Mode.AUTOMATIC
            or session.number
            or session.outside_changes
            or channel.good_samples != good + 1
        ):
            return
        if self._before[1] is None:  # PV had been away since
            base, pv = self._before[2], None
        base = min(max(base, settings.mv_low), settings.mv_high)
        wanted = base if pv is None or channel.pv is None else base + channel.accepted.Kp * (pv - channel.pv)
        wanted = min(max(wanted, settings.mv_low), settings.mv_high)
        if not settings.rate_limit_per_s and not _near(channel.mv, wanted):
            self.say(f"a bump after the session: MV {channel.mv:g}, not {wanted:g}")

    def _reset(self, session: Session) -> None:
        """Reset node: as at power-on, but for what is kept."""
        self._session = session
        self._rpdo = None
        self._held_mv = self._last = self._bump = self._relay = None
        if self.controller.keep:
            self._change(trial=None)
        else:
            start = self.controller.start_values
            self._change(
                mode=Mode(start.mode), sp=start.setpoint, output=start.manual_output, accepted=start.parameters,
                trial=None,
            )  # fmt: skip
        self.hands.append((self.simulation.now, "restart"))
        self.simulation.note("truth", f"reset; {self.words()}")

    # -- what a job says

    def moved(self, gateway: str, row: Job, state: JobState, restoring_since: float, since: float) -> None:
        """A job has got a state: it must agree with what the controller held as it was read."""
        reason = row.reason or ""
        self.simulation.note(gateway, f"job is {state.value} {reason} {row.detail or ''}".rstrip())
        if state in ACTIVE:
            return
        if reason == "internal" and not self.a_defect_is_put_in:
            self.say(f"internal: {row.detail}")
        restored = row.restored
        if restored is not None and (state not in (JobState.ACCEPTED, JobState.ROLLED_BACK) or row.result):
            self._compare(state, restored, restoring_since, row.session)
        what = _OF_HANDS.get(reason)
        if what is not None and not any(at >= since and kind in (what, "restart") for at, kind in self.hands):
            self.say(f"it says {reason}, and nobody's hand was on it: {row.detail}")
        another = any(each.session for each in self.held) and "holds the loop" in (row.detail or "")
        if "somebody else" in (row.detail or "") and not another and not any(at >= since for at, _ in self.hands):
            self.say(f"it says that somebody else has changed the loop, and nobody has: {row.detail}")

    def _compare(self, state: JobState, restored: dict[str, Any], since: float, session: int | None) -> None:
        window = [each for each in self.held if each.since >= since]
        before = [each for each in self.held if each.since < since]
        window = before[-1:] + window
        if not window:
            return
        gains = Parameters(*(restored["gains"][name] for name in ("Kp", "Ti", "Td", "Tf", "b", "c")))
        mode = Mode[restored["mode"].upper()]
        wrong = []
        if not any(each.mode == mode for each in window):
            wrong.append(f"mode {mode.name}")
        if not any(same(each.sp, restored["sp"]) for each in window):
            wrong.append(f"SP {restored['sp']:g}")
        if not any(each.on_trial == restored["on_trial"] for each in window):
            wrong.append(f"on trial {restored['on_trial']}")
        if not any(_same_set(each.accepted, gains) for each in window):
            wrong.append(f"gains {gains}")
        if wrong:
            self.say(f"the job says what the controller did not hold: {', '.join(wrong)}; it held {window[-1]}")
        if session and all(each.session == session for each in window):
            self.say("the job says restored while its session was open")

    def held_jobs(self, rows: Sequence[Job]) -> None:
        """The rows of a gateway that is up at the end: a job that has had its loop held says so, and no other does."""
        restarted = any(kind == "restart" for _, kind in self.hands)
        for row in rows:
            if row.session in self.holds and not (row.false_pv or row.restore_unconfirmed or restarted):
                self.say(f"the loop was held, and its job does not say so: {row.state} {row.reason} {row.detail}")
            if row.false_pv and not self.plant.sensor.was_false:
                self.say(f"a job says that PV was false, and it was not: {row.detail}")
            if row.false_pv and row.state is not JobState.FAILED and row.state is not JobState.INTERRUPTED:
                self.say(f"a job that has found PV to be false is: {row.state}")

    # -- the end

    def at_the_end(self, passes: bool) -> None:
        """passes: whether frames have passed for a while between controller and plant, both of them operational."""
        controller, plant = self.controller, self.plant
        if not controller.is_on:
            return
        self._last = None
        self.look()
        session = controller.device.sessions[0]
        channel = session.channel
        if session.is_open:
            self.say(f"a session is open at the end: of {session.holder:02X}h")
        if not plant.is_on or self.wire.state is not State.UP:
            return
        settings = channel.settings

        def limited(mv: float) -> float:
            return min(max(mv, settings.mv_low), settings.mv_high)

        if not passes:
            return
        flowing = session.pv_is_valid or channel.bad_samples > self._bad_samples
        at_plant = [channel.mv] if flowing else []
        if channel.mode is Mode.MANUAL:
            at_plant = [limited(channel.manual_output)]
        elif channel.mode is Mode.OFF:
            at_plant = [limited(settings.safe_output)]
        elif self._held_mv is not None:
            at_plant = [self._held_mv]
        if not flowing and plant.on_missing == OnMissingAnswer.SAFE_OUTPUT:
            at_plant.append(50.0)  # the I/O's own reaction
        if not flowing and not any(each.session for each in self.held):
            return  # there was no test, and nobody asked for another output
        if at_plant and not any(_near(plant.mv, mv) for mv in at_plant):
            self.say(
                f"MV at the plant, {channel.mode.name}, PV {'comes' if flowing else 'does not come'}: "
                f"{plant.mv:g}, not {at_plant[0]:g}"
            )

    def before_the_end(self) -> None:
        """To be called a few samples before it: whether PV comes is seen by then."""
        if self.controller.is_on:
            self._bad_samples = self.controller.device.sessions[0].channel.bad_samples


def _near(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-5)


def _same_set(one: Parameters, other: Parameters) -> bool:
    return all(same(getattr(one, name), getattr(other, name)) for name in Parameters.__dataclass_fields__)


def real32(value: float) -> float:
    """As it travels."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])
