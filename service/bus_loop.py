"""The live loop: a controller and its plant on a CAN bus, as a plan sees it.

Every wait in here also sends our heartbeat, and the lease is renewed from `step` alone: a service that hangs or dies
loses the loop, and the controller goes back to its accepted set by itself.

A simulated plant that runs as fast as the answers come (pace 0) is run in blocks of samples: no sample is lost however
slow we are, and commands act between two blocks, so that equal seeds give equal runs.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace

from protocol.bus import BusError
from protocol.objects import Device, default_of, lookup
from protocol.profile import FOREVER, TUNER_NODE, Abort, Cause, Emcy, Experiment, ParameterCommand
from protocol.tuner import BusSample, Kind, Tuner, TunerError
from service.loop import LoopState
from service.metrics import SAMPLES_LOST
from tuning.gains import Gains
from tuning.plan import Command, Mode, Sample, SetGains, SetMode, SetOutput, SetRelay, SetSetpoint
from tuning.reasons import Aborted, Ended, Failed, Reason, Refused

HEARTBEAT_WATCH_MS = 1000
"""Wall time without our heartbeat after which the controller goes back by itself."""
LEASE_WALL_S = 3.0
LEFTOVER_S = LEASE_WALL_S + 1.0
"""How long a session of another tuner may take to end before we begin."""
SHORTEST_LEASE = 20
SILENCE_S = 1.0
"""Wall time without a sample (at least three sampling periods) after which the nodes are asked whether they live."""
RESTORE_PATIENCE_S = 4.0
COMMAND_WALL_S = 2.0
"""How long a handful of commands may take on a slow bus."""
FASTEST_PER_S = 20_000
"""More samples a second than a simulated plant at pace 0 makes when nobody runs it in blocks."""
RELAY_LONGEST = 1_000_000  # samples; plans end their relays, and so does the lease
MAX_GAP = 5

_PARAMETERS = ("kp", "ti", "td", "tf", "b", "c")
_WENT_BACK = (Emcy.HEARTBEAT_LOST, Emcy.LEASE_USED_UP, Emcy.PV_LIMIT)
_NOT_OURS = (Abort.NO_OBJECT, Abort.NO_SUBINDEX, Abort.LENGTH, Abort.READ_ONLY, Abort.WRITE_ONLY)

# A plant that we run in blocks belongs to one job at a time, whatever its number of channels.
_plants: dict[tuple[str, int], threading.Lock] = {}
_plants_guard = threading.Lock()


class BusLoop:
    """One channel of a controller node. plant_node: the plant I/O, if it offers one to ask (a simulated one does).

    block: samples per block of a plant at pace 0.  max_gap: samples in a row that may be missing.
    """

    def __init__(
        self,
        bus_url: str,
        controller_node: int,
        plant_node: int | None,
        channel: int = 1,
        *,
        block: int = 10,
        max_gap: int = MAX_GAP,
    ) -> None:
        self._url = bus_url
        self._node = controller_node
        self._plant = plant_node
        self._channel = channel
        self._block = block
        self._max_gap = max_gap
        self._tuner: Tuner | None = None
        self._held: threading.Lock | None = None
        self._in_blocks = False
        self._pace = 1.0
        self._left = 0  # samples of the present block still to come
        self._commands: list[Command] = []
        self._sample_time_s = 0.0
        self._silence_s = SILENCE_S
        self._lease = SHORTEST_LEASE
        self._until_renewal = 0
        self._paid_at = 0.0
        self._until_look = 0
        self._relay_written: dict[str, float] = {}
        self._mode_found: Mode | None = None
        self._tried: Gains | None = None
        self._first_n: int | None = None
        self._last_n = 0

    # -- what a Loop does

    def read(self) -> LoopState:
        with self._translated() as tuner:
            return self._state(tuner)

    def begin(self, stop: Callable[[], Reason | None] = lambda: None) -> LoopState:
        try:
            with self._translated() as tuner:
                self._identify(tuner)
                self._compare_times(tuner)
                self._take_plant(tuner, stop)
                self._watch_us(tuner)
                self._take_time(tuner)
                state = replace(self._state(tuner), command_lag_samples=self._command_lag())
                self._no_experiment(state.mode)
                self._plan_lease()
                tuner.write("controller_lease", self._lease)
                self._paid_at = time.monotonic()
                tuner.drain()
                tuner.mode, tuner.on_trial, tuner.sp = state.mode, state.on_trial, state.sp
                tuner.emergencies.clear()
                tuner.restarted = False
                self._until_renewal = self._until_look = self._lease // 3
                self._relay_written.clear()
                self._mode_found = state.mode
                self._first_n, self._left, self._tried = None, 0, None
                self._commands.clear()
                return state
        except BaseException:
            self._release()
            raise

    @property
    def waits(self) -> bool:
        return self._in_blocks

    def step(self, commands: Sequence[Command]) -> Sample:
        with self._translated() as tuner:
            self._commands += commands
            if self._left <= 0:
                self._keep(tuner)
                if self._commands:
                    self._until_look = self._command_lag() // 2
                for command in self._commands:
                    self._carry_out(tuner, command)
                self._commands.clear()
                if self._until_look <= 0:
                    self._look(tuner)
                if self._in_blocks:
                    tuner.write("plant_samples_to_run", self._block)
                    self._left = self._block
            found = tuner.sample(self._silence_s)
            while found is not None and self._first_n is not None and found.n == self._last_n:
                found = tuner.sample(self._silence_s)  # a frame that came twice
            if tuner.emergencies or tuner.restarted:
                self._hear(tuner)
            if found is None:
                raise self._silent(tuner)
            if found.on_trial and self._tried is None:
                raise Aborted(Reason.GAINS_CHANGED, "gains are on trial that this test has not given")
            return self._count(found)

    def restore(self, state: LoopState) -> LoopState:
        give_up = time.monotonic() + RESTORE_PATIENCE_S
        try:
            while True:
                try:
                    return self._bring_back(state)
                except Ended as ended:
                    if time.monotonic() > give_up:
                        raise Failed(Reason.RESTORE_UNCONFIRMED, ended.detail) from ended
                    time.sleep(0.05)
        finally:
            self._release()

    def accept(self, gains: Gains) -> LoopState:
        """In a short session of its own, so that gains whose acceptance fails, or whose tuner dies, do not stay."""
        try:
            with self._translated() as tuner:
                self._watch_us(tuner)
                self._no_experiment(Mode(int(tuner.number("controller_mode"))))
                lease = self._short_lease(tuner)
                self._stage(tuner, gains)
            try:
                with self._translated() as tuner:
                    tuner.write("controller_lease", lease)
                    tuner.write("controller_parameter_command", ParameterCommand.TRY)
                    tuner.write("controller_parameter_command", ParameterCommand.ACCEPT)
                state = self._let_go()
                if state.on_trial or not _same_gains(state.gains, gains):
                    raise Failed(Reason.RESTORE_UNCONFIRMED, f"accepted {gains}, read back {state.gains}")
                return state
            except Ended as ended:
                return self._after_all(gains, ended)
        finally:
            self._release()

    def close(self) -> None:
        self._release()
        self._forget()

    # -- the way in

    def _identify(self, tuner: Tuner) -> None:
        for node, device in ((self._node, Device.CONTROLLER), (self._plant, Device.PLANT)):
            if node is None:
                continue
            found = int(tuner.number("device_type", node=node))
            expected = int(default_of(lookup("device_type"), 0, device))
            if found != expected:
                text = f"node {node:02X}h is of type {found:08X}h, not a {device.value} ({expected:08X}h)"
                raise Refused(Reason.DEVICE_MISMATCH, text)

    def _compare_times(self, tuner: Tuner) -> None:
        """A controller that reckons with another sample time than the plant's has other gains than it shows."""
        if self._plant is None:
            return
        ours, theirs = (tuner.number("sample_time", node=node) / 1e6 for node in (self._node, self._plant))
        if ours != theirs:
            text = f"controller node {self._node:02X}h has a sample time of {ours:g} s"
            raise Refused(Reason.DEVICE_MISMATCH, f"{text}, plant node {self._plant:02X}h one of {theirs:g} s")

    def _watch_us(self, tuner: Tuner) -> None:
        """Arms the watch on our heartbeat. A session that a dead tuner left ends first, for want of its heartbeat."""
        give_up = time.monotonic() + LEFTOVER_S
        while tuner.number("controller_lease"):
            if time.monotonic() > give_up:
                raise Refused(Reason.WRONG_MODE, "another tuner holds the lease of this loop")
            time.sleep(0.05)
        tuner.write("heartbeat_consumer", TUNER_NODE << 16 | HEARTBEAT_WATCH_MS, sub=1, node=self._node)
        tuner.hold()
        if tuner.number("controller_on_trial"):
            tuner.write("controller_parameter_command", ParameterCommand.GO_BACK)

    def _take_plant(self, tuner: Tuner, stop: Callable[[], Reason | None]) -> None:
        """Waits for its turn on a plant that is run in blocks; before anything of ours is armed in the controller."""
        self._pace = tuner.number("plant_pace") if self._plant is not None else 1.0
        self._in_blocks = self._pace == 0.0
        if not self._in_blocks or self._plant is None:
            return
        with _plants_guard:
            lock = _plants.setdefault((self._url, self._plant), threading.Lock())
        while not lock.acquire(timeout=0.1):
            if (reason := stop()) is not None:
                raise Aborted(reason, f"while another test was using plant node {self._plant:02X}h")
        self._held = lock

    def _take_time(self, tuner: Tuner) -> None:
        """Who drives the samples: the plant by its clock, or we in blocks."""
        self._sample_time_s = tuner.number("sample_time", node=self._node) / 1e6
        per_sample_s = self._sample_time_s / (self._pace or math.inf)
        self._silence_s = max(SILENCE_S, 3.0 * per_sample_s)
        if self._in_blocks:
            tuner.write("plant_samples_to_run", 0)
            while tuner.sample(0.03) is not None:
                pass
        elif self._plant is not None and not tuner.number("plant_samples_to_run"):
            tuner.write("plant_samples_to_run", FOREVER)

    def _command_lag(self) -> int:
        """A block, or the samples that come while several commands wait for slow answers."""
        if self._in_blocks:
            return 5 * self._block
        return max(50, math.ceil(COMMAND_WALL_S * self._pace / self._sample_time_s))

    def _plan_lease(self) -> None:
        """Samples we pay for at a time: some seconds of wall time, or some blocks."""
        if self._in_blocks:
            self._lease = 60 * self._block
            return
        self._lease = max(SHORTEST_LEASE, math.ceil(LEASE_WALL_S * self._pace / self._sample_time_s))

    def _short_lease(self, tuner: Tuner) -> int:
        """Samples of LEASE_WALL_S, whoever runs the plant. It may run freely at pace 0; where it stands still, the
        watch on our heartbeat alone ends a session."""
        pace = tuner.number("plant_pace") if self._plant is not None else 1.0
        per_s = pace / (tuner.number("sample_time", node=self._node) / 1e6) if pace else FASTEST_PER_S
        return max(SHORTEST_LEASE, math.ceil(LEASE_WALL_S * per_s))

    @staticmethod
    def _no_experiment(mode: Mode) -> None:
        if mode is Mode.EXPERIMENT:
            text = "an experiment is running in the controller: wait for its end, or set the mode to automatic"
            raise Refused(Reason.WRONG_MODE, text)

    # -- on the way

    def _carry_out(self, tuner: Tuner, command: Command) -> None:
        match command:
            case SetSetpoint(value):
                tuner.write("controller_setpoint", value)
            case SetMode(Mode.EXPERIMENT):
                pass  # SetRelay has started it; commanded again it would start anew
            case SetMode(mode):
                tuner.write("controller_mode_command", mode)
            case SetGains(gains):
                self._try(tuner, gains, self._keep)
                self._tried = gains
            case SetOutput(value):
                tuner.write("controller_manual_output", value)
            case SetRelay():
                self._start_relay(tuner, command)

    def _start_relay(self, tuner: Tuner, relay: SetRelay) -> None:
        """Writes what is not as it was written before: a relay that only gets another amplitude soon has it."""
        wanted = {
            "amplitude": relay.amplitude,
            "hysteresis": relay.hysteresis,
            "working_output": relay.working_output,
            "parallel_gain": 0.0,  # the controller has one, no procedure wants it
            "amplitude_low": relay.amplitude_low or 0.0,
            "average": relay.average,
            "max_samples": RELAY_LONGEST,
        }
        if not self._relay_written:
            wanted |= {name: tuner.number(f"controller_{name}") for name in ("pv_low", "pv_high")}
        for name, value in wanted.items():
            if self._relay_written.get(name) != value:
                self._keep(tuner)
                tuner.write(f"controller_relay_{name}", value)
                self._relay_written[name] = value
        tuner.write("controller_experiment", Experiment.RELAY)
        tuner.write("controller_mode_command", Mode.EXPERIMENT)

    def _try(self, tuner: Tuner, gains: Gains, pay: Callable[[Tuner], None] = lambda tuner: None) -> None:
        """pay: what keeps the session open while one write waits for the other, if there is a session."""
        self._stage(tuner, gains, pay)
        tuner.write("controller_parameter_command", ParameterCommand.TRY)

    def _stage(self, tuner: Tuner, gains: Gains, pay: Callable[[Tuner], None] = lambda tuner: None) -> None:
        values = (gains.Kp, gains.Ti, gains.Td, gains.Tf, gains.b, gains.c)
        for name, value in zip(_PARAMETERS, values, strict=True):
            pay(tuner)
            tuner.write(f"controller_staged_{name}", value)

    def _keep(self, tuner: Tuner) -> None:
        """Pays for more when a third is used up: by samples, or by wall time that went by in waiting for answers of a
        node that many loops ask."""
        waited = not self._in_blocks and time.monotonic() - self._paid_at > LEASE_WALL_S / 3
        if self._until_renewal <= 0 or waited:
            self._renew(tuner)

    def _renew(self, tuner: Tuner) -> None:
        """Pays for the session that is open; a lease written after its end would open another one."""
        try:
            tuner.write("controller_lease_renewal", self._lease)
        except TunerError as error:
            if error.code == Abort.DEVICE_STATE:
                raise self._gone_back(tuner) from error
            raise
        self._until_renewal, self._paid_at = self._lease // 3, time.monotonic()

    def _look(self, tuner: Tuner) -> None:
        """Asks for what the status frames tell (one of them may have been lost), and for what none tells: whether the
        gains on trial are still ours."""
        tuner.sp = tuner.number("controller_setpoint")
        tuner.mode = int(tuner.number("controller_mode"))
        if self._tried is not None:
            Kp, Ti = (tuner.number(f"controller_staged_{name}") for name in ("kp", "ti"))
            if not (_same(Kp, self._tried.Kp) and _same(Ti, self._tried.Ti)):
                text = f"somebody else has put Kp {Kp:.6g}, Ti {Ti:.6g} s in the place of the gains on trial"
                raise Aborted(Reason.GAINS_CHANGED, text)
        self._until_look = self._lease * 2 // 3

    def _hear(self, tuner: Tuner) -> None:
        """An emergency may concern another channel: our own lease tells."""
        codes, tuner.emergencies = tuner.emergencies, []
        if tuner.restarted:
            tuner.restarted = False
            raise self._restarted()
        if any(code in _WENT_BACK for code in codes) and not tuner.number("controller_lease"):
            raise self._gone_back(tuner)

    def _restarted(self) -> Failed:
        return Failed(Reason.NODE_LOST, f"controller node {self._node:02X}h restarted")

    def _gone_back(self, tuner: Tuner) -> Failed:
        cause = Cause(int(tuner.number("controller_cause")))
        if cause is Cause.PV_LIMIT:
            return Failed(Reason.PV_LIMIT, "PV left its span during the experiment; the controller ended it")
        if cause is Cause.NONE:  # it has never held a lease of ours
            return self._restarted()
        name = cause.name.lower().replace("_", " ")
        return Failed(Reason.DEVICE_WENT_BACK, f"the controller ended the trial by itself (cause: {name})")

    def _silent(self, tuner: Tuner) -> Failed:
        """No samples: who is it? A node that is gone raises by its time-out."""
        tuner.number("controller_mode")
        if self._plant is not None:
            tuner.number("plant_samples_to_run")
        if not tuner.number("controller_lease"):
            return self._gone_back(tuner)
        return Failed(Reason.SAMPLES_LOST, f"no sample for {self._silence_s:g} s although the nodes answer")

    def _count(self, found: BusSample) -> Sample:
        if self._first_n is None:
            self._first_n, self._last_n = found.n, found.n - 1
        passed = found.n - self._last_n
        self._last_n = found.n
        if passed < 1:
            raise Failed(Reason.SAMPLES_LOST, f"the plant started anew: sample {found.n} after {found.n - passed}")
        if passed > 1:
            SAMPLES_LOST.labels(self._url).inc(passed - 1)
        if passed > self._max_gap + 1:
            raise Failed(Reason.SAMPLES_LOST, f"{passed - 1} samples missing before sample {found.n}")
        self._left -= passed if self._in_blocks else 0
        self._until_renewal -= passed
        self._until_look -= passed
        return Sample((found.n - self._first_n) * self._sample_time_s, found.sp, found.pv, found.mv, found.mode)

    # -- the way out

    def _bring_back(self, state: LoopState) -> LoopState:
        with self._translated() as tuner:
            if state.mode is not self._mode_found and tuner.number("controller_mode") == state.mode:
                tuner.write("controller_lease", 0)  # ends the trial; their mode and output stay
            tuner.write("controller_parameter_command", ParameterCommand.GO_BACK)
            if not _same_gains(_gains(tuner, "accepted"), state.gains):
                self._make_accepted(tuner, state.gains)
            tuner.write("controller_setpoint", state.sp)
            tuner.write("controller_mode_command", state.mode)
            tuner.write("controller_lease", 0)
            found = self._state(tuner)
        differences = [
            f"{name} is {is_}, was {was}"
            for name, is_, was, same in (
                ("mode", found.mode.name, state.mode.name, found.mode is state.mode),
                ("set-point", found.sp, state.sp, _same(found.sp, state.sp)),
                ("gains", found.gains, state.gains, _same_gains(found.gains, state.gains)),
                ("trial", found.on_trial, False, not found.on_trial),
            )
            if not same
        ]
        if differences:
            raise Failed(Reason.RESTORE_UNCONFIRMED, "; ".join(differences))
        return found

    def _make_accepted(self, tuner: Tuner, gains: Gains) -> None:
        self._try(tuner, gains)
        tuner.write("controller_parameter_command", ParameterCommand.ACCEPT)

    def _let_go(self) -> LoopState:
        """The state without a session. A lease of 0 ends what is on trial and leaves mode, set-point and output as they
        are; going back would undo a hand that has been on them meanwhile."""
        with self._translated() as tuner:
            tuner.write("controller_lease", 0)
            return self._state(tuner)

    def _after_all(self, gains: Gains, why: Ended) -> LoopState:
        """An acceptance that has failed: nothing may stay on trial. Where only an answer was lost, the gains are
        accepted: what is read back counts."""
        give_up = time.monotonic() + RESTORE_PATIENCE_S
        state: LoopState | None = None
        while state is None or state.on_trial:
            if time.monotonic() > give_up:
                text = "the end of the trial is not confirmed, the controller ends it by itself within seconds"
                raise type(why)(why.reason, f"{why.detail}; {text}: read the loop before going on") from why
            try:
                state = self._let_go()
            except Ended:
                time.sleep(0.05)
        if not _same_gains(state.gains, gains):
            raise why
        return state

    def _release(self) -> None:
        """Our heartbeat ends; a plant that we ran in blocks runs on by itself, and others may take it.

        The watch on it stays armed: it is the node's, not the channel's, and another process may hold a loop there.
        A controller that does not tell an idle tuner from a lost one says 8130h once we are silent; it harms nothing.
        """
        if self._tuner is not None:
            self._tuner.beating = False
        if self._held is None:
            return
        with suppress(Ended), self._translated() as tuner:
            tuner.write("plant_samples_to_run", FOREVER)
        self._held.release()
        self._held = None

    def _forget(self) -> None:
        if self._tuner is not None:
            self._tuner.close()
            self._tuner = None

    # -- common

    @contextmanager
    def _translated(self) -> Iterator[Tuner]:
        """The tuner, opened when needed; what goes wrong on the bus becomes a reason of the closed list."""
        try:
            if self._tuner is None:
                self._tuner = Tuner(self._url, self._node, self._plant, self._channel)
            yield self._tuner
        except BusError as error:
            self._forget()
            raise Failed(Reason.BUS_LOST, str(error)) from error
        except OSError as error:  # an interface that disappears between two calls
            self._forget()
            text = f"bus {self._url!r} is lost ({error.strerror or error}): see that its interface is there and up"
            raise Failed(Reason.BUS_LOST, text) from error
        except TunerError as error:
            if error.kind is Kind.TIMEOUT:
                raise Failed(Reason.NODE_LOST, str(error)) from error
            if error.code in _NOT_OURS:
                raise Refused(Reason.DEVICE_MISMATCH, str(error)) from error
            raise Refused(Reason.BAD_INPUT, f"the controller refused: {error}") from error

    def _state(self, tuner: Tuner) -> LoopState:
        """The gains are the accepted ones, in or out of a trial: those that it ends with. Whoever reads here has none
        on trial itself; what somebody else tries, or has forgotten, must not be written down as what to restore."""
        return LoopState(
            mode=Mode(int(tuner.number("controller_mode"))),
            sp=tuner.number("controller_setpoint"),
            pv=tuner.number("controller_received_pv"),
            mv=tuner.number("controller_mv"),
            gains=_gains(tuner, "accepted"),
            on_trial=bool(tuner.number("controller_on_trial")),
            mv_low=tuner.number("controller_mv_low"),
            mv_high=tuner.number("controller_mv_high"),
            sample_time_s=tuner.number("sample_time", node=self._node) / 1e6,
            reverse_acting=tuner.number("controller_action") == 0,
        )


def _gains(tuner: Tuner, which: str) -> Gains:
    return Gains(*(tuner.number(f"controller_{which}_{name}") for name in _PARAMETERS))


def _same(a: float, b: float) -> bool:
    """Equal as far as REAL32 can tell."""
    return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-12)


def _same_gains(a: Gains, b: Gains) -> bool:
    pairs = ((a.Kp, b.Kp), (a.Ti, b.Ti), (a.Td, b.Td), (a.Tf, b.Tf), (a.b, b.b), (a.c, b.c))
    return all(_same(one, other) for one, other in pairs)
