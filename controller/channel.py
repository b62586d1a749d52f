"""The control of one loop: modes, limits, the relay, gains on trial, and the return to the state before a test.

A change of the control law or the mode never moves the output (except to OFF and MANUAL, which have outputs of their
own). `controller.session` decides who may command what, and when a test ends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from loopwright.controller.pid import Parameters, Pid
from loopwright.controller.relay import Relay, RelaySettings
from loopwright.protocol.profile import Mode, RelayState
from loopwright.protocol.real32 import fits

__all__ = ["Channel", "Home", "Mode", "Parameters", "RelaySettings", "RelayState", "Settings"]


@dataclass(frozen=True, slots=True)
class Settings:
    """Limits and PV span of a channel.

    mv_low, mv_high, safe_output: limits of MV, and MV in mode OFF, in MV units.
    rate_limit_per_s: largest rate of MV, MV units per s; 0 for none.
    pv_low, pv_high: the PV span, PV units. A PV that lies farther outside than the span is wide is not a valid
    measurement.
    reverse: whether MV falls as PV rises.
    Raises ValueError.
    """

    mv_low: float = 0.0
    mv_high: float = 100.0
    safe_output: float = 0.0
    rate_limit_per_s: float = 0.0
    pv_low: float = 0.0
    pv_high: float = 100.0
    reverse: bool = True

    def __post_init__(self) -> None:
        _finite(self.mv_low, self.mv_high, self.safe_output, self.rate_limit_per_s, self.pv_low, self.pv_high)
        if self.mv_low > self.mv_high:
            raise ValueError("the low output limit must not exceed the high one")
        if self.pv_low > self.pv_high:
            raise ValueError("the low end of the PV span must not exceed the high one")
        if self.rate_limit_per_s < 0:
            raise ValueError("the rate limit must not be negative")

    def measured(self, pv: float) -> bool:
        """Returns whether this PV is a valid measurement."""
        width = self.pv_high - self.pv_low
        return self.pv_low - width <= pv <= self.pv_high + width


@dataclass(frozen=True, slots=True)
class Home:
    """The state to which a channel returns at the end of a test; PV and MV units."""

    mode: Mode
    setpoint: float
    manual_output: float
    mv: float

    def held(self) -> Home:
        """Returns the state in place of this one where PV is false: AUTOMATIC becomes MANUAL at this MV."""
        return replace(self, mode=Mode.MANUAL, manual_output=self.mv) if self.mode is Mode.AUTOMATIC else self


class Channel:
    """A control channel: `step`, called once per sample with the PV, returns the MV that holds until the next sample.

    A PV that is not finite, or far outside its span, is counted in `bad_samples` and otherwise ignored; AUTOMATIC and
    the relay then hold MV. MANUAL and OFF need no PV.
    """

    def __init__(
        self,
        sample_time_s: float,
        settings: Settings,
        parameters: Parameters,
        setpoint: float,
        mode: Mode | int,
        manual_output: float = 0.0,
    ) -> None:
        _finite(setpoint, manual_output)
        if mode == Mode.EXPERIMENT:
            raise ValueError("a channel cannot start with an experiment")
        self.accepted = parameters
        self.staged = parameters
        self.in_effect = parameters
        self.on_trial = False
        self.accept_count = 0
        self.bad_samples = 0
        self.good_samples = 0
        self.measuring = False
        """Whether the last PV was valid."""
        self.relay_state = RelayState.IDLE
        self._sample_time_s = sample_time_s
        self._settings = settings
        self._mode = Mode(mode)
        self._setpoint = setpoint
        self._manual_output = manual_output
        self._relay: Relay | None = None
        self.pv: float | None = None
        self._pid = Pid(sample_time_s, parameters, settings.reverse)
        self._mv = self._limited(settings.safe_output if self._mode is Mode.OFF else manual_output)
        self._takes_over = self._mv
        """The output from which the next control law, or MANUAL, continues, MV units."""

    @property
    def mode(self) -> Mode:
        return self._mode

    @property
    def mv(self) -> float:
        return self._mv

    @property
    def relay(self) -> Relay | None:
        return self._relay

    @property
    def setpoint(self) -> float:
        return self._setpoint

    @setpoint.setter
    def setpoint(self, value: float) -> None:
        _finite(value)
        self._setpoint = value

    @property
    def manual_output(self) -> float:
        return self._manual_output

    @manual_output.setter
    def manual_output(self, value: float) -> None:
        _finite(value)
        self._manual_output = value

    @property
    def settings(self) -> Settings:
        return self._settings

    @settings.setter
    def settings(self, value: Settings) -> None:
        self._settings = value
        self._use(self.in_effect)

    def step(self, pv: float) -> float:
        """Returns the MV for this sample."""
        self.measuring = self._settings.measured(pv)
        if self.measuring:
            self.good_samples += 1
            if self.pv is None:
                self._pid.rebase(self._setpoint, pv, self._takes_over)
            self.pv = pv
            self._mv = self._takes_over = self._answer(pv)
        else:
            self.bad_samples += 1
            if self._mode is Mode.MANUAL or self._mode is Mode.OFF:
                self._mv = self._takes_over = self._answer(pv)
        return self._mv

    def command_mode(self, mode: Mode | int) -> None:
        """Changes to OFF, MANUAL (at the present output) or AUTOMATIC; only `start_relay` starts an experiment.

        Raises ValueError.
        """
        mode = Mode(mode)
        if mode is self._mode:
            return
        if mode is Mode.EXPERIMENT:
            raise ValueError("an experiment is started with its parameters, not by a mode")
        self._end_relay(RelayState.DONE)
        self._mode = mode
        self._use(self.in_effect)
        if mode is Mode.MANUAL:
            self._manual_output = self._takes_over

    def stage(self, parameters: Parameters) -> None:
        """Stores gains that are not in effect yet."""
        self.staged = parameters

    def try_gains(self, parameters: Parameters) -> None:
        """Puts these gains on trial, all of them in one sample."""
        self.on_trial = True
        if parameters != self.in_effect:
            self._use(parameters)

    def accept(self, parameters: Parameters) -> None:
        """Makes these gains the accepted set, and puts them in effect."""
        if parameters != self.in_effect:
            self._use(parameters)
        self.accepted = parameters
        self.on_trial = False
        self.accept_count += 1

    def go_back(self) -> None:
        """Ends the trial and returns to the accepted set without a bump."""
        self.on_trial = False
        self._use(self.accepted)

    def start_relay(self, settings: RelaySettings) -> None:
        """Starts mode EXPERIMENT. A running relay takes the new settings and stays on its present side."""
        error = 0.0 if self.pv is None else self._error(self.pv)
        self._relay = Relay(settings, error, self._relay)
        self._mode = Mode.EXPERIMENT
        self.relay_state = RelayState.RUNNING

    @property
    def home(self) -> Home:
        """Returns the present state, to return to later; directly after a relay, its MV is the relay's working
        output."""
        return Home(self._mode, self._setpoint, self._manual_output, self._takes_over)

    def go_home(self, home: Home, relay_state: RelayState = RelayState.DONE) -> None:
        """Ends trial and relay; restores the accepted gains, and mode, set-point and manual output of `home`.

        The control law continues from the present output, or from the working output if a relay ran.
        """
        self._end_relay(relay_state)
        self.on_trial = False
        self._mode, self._setpoint, self._manual_output = home.mode, home.setpoint, home.manual_output
        self._use(self.accepted)

    def without_pv(self, mv: float) -> None:
        """Sets the output at once where no PV arrives: the manual or safe output, or in AUTOMATIC `mv`, from which the
        control law continues when PV returns. The rate limit is not applied, because no next sample would continue
        it."""
        outputs = {Mode.MANUAL: self._manual_output, Mode.OFF: self._settings.safe_output}
        self._mv = self._takes_over = self._limited(outputs.get(self._mode, mv))
        self.pv = None

    def _end_relay(self, state: RelayState) -> None:
        if self._relay is not None:
            self._takes_over = self._limited(self._relay.settings.working_output)
            self._relay = None
            self.relay_state = state

    def _use(self, parameters: Parameters) -> None:
        """Switches to these parameters without a bump."""
        self.in_effect = parameters
        self._pid = Pid(self._sample_time_s, parameters, self._settings.reverse)
        if self.pv is not None:
            self._pid.rebase(self._setpoint, self.pv, self._takes_over)

    def _error(self, pv: float) -> float:
        return self._setpoint - pv if self._settings.reverse else pv - self._setpoint

    def _limited(self, output: float) -> float:
        return min(max(output, self._settings.mv_low), self._settings.mv_high)

    def _answer(self, pv: float) -> float:
        """Returns the output of the present mode for this PV, within limits and rate."""
        settings = self._settings
        low, high = settings.mv_low, settings.mv_high
        if settings.rate_limit_per_s and self._mode is not Mode.OFF:
            reach = settings.rate_limit_per_s * self._sample_time_s
            # Limits that have been moved away from the present output take precedence over the rate.
            low, high = min(max(low, self._mv - reach), high), max(min(high, self._mv + reach), low)
        if self._mode is Mode.AUTOMATIC:
            return self._pid.step(self._setpoint, pv, low, high)
        if self._relay is not None:
            wanted = self._relay.output(self._error(pv))
        elif self._mode is Mode.MANUAL:
            wanted = self._manual_output
        else:
            wanted = settings.safe_output
        return low if wanted < low else high if wanted > high else wanted


def _finite(*values: float) -> None:
    if not all(fits(value) for value in values):
        raise ValueError("values must be finite, and within the range of a REAL32")
