"""One loop inside the controller: modes, limits, the relay, sets on trial, and the way back.

Changing the law or the mode never moves the output (OFF and MANUAL go to the output they stand for). What a tuner
tries lives in a session: the first lease opens it and notes mode, set-point and manual output; when the lease runs out,
or on `go_back`, the accepted parameters and all three come back.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from controller.pid import Parameters, Pid
from protocol.profile import Cause, ExperimentState, Mode

MOST_AVERAGED = 100

__all__ = ["Cause", "Channel", "ExperimentState", "Mode", "Parameters", "Settings"]


@dataclass(frozen=True, slots=True)
class Settings:
    """Limits in MV units (rate: per s, 0 = none) and the PV span; reverse: MV falls as PV rises.

    A PV that is farther outside its span than the span is wide is no measurement.
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
        width = self.pv_high - self.pv_low
        return self.pv_low - width <= pv <= self.pv_high + width


@dataclass(slots=True)
class _Relay:
    amplitude: float
    hysteresis: float
    working_output: float
    parallel_gain: float
    samples_left: int
    pv_low: float
    pv_high: float
    high: bool
    amplitude_low: float
    errors: deque[float]


@dataclass(frozen=True, slots=True)
class _Latched:
    mode: Mode
    setpoint: float
    manual_output: float


class Channel:
    """Call `step` once per sample with the PV; it answers with the MV that holds until the next one.

    A PV that is not finite, or far outside its span, holds the MV of AUTOMATIC and of the relay, and counts in
    `bad_samples`; nothing of it is remembered. MANUAL and OFF need no PV.
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
        self.cause = Cause.NONE
        self.accept_count = 0
        self.bad_samples = 0
        self.experiment_state = ExperimentState.IDLE
        self._sample_time_s = sample_time_s
        self._settings = settings
        self._mode = Mode(mode)
        self._mode_after_relay = self._mode
        self._setpoint = setpoint
        self._manual_output = manual_output
        self._relay: _Relay | None = None
        self._session: _Latched | None = None
        self._lease = 0
        self._pv: float | None = None
        self._pid = Pid(sample_time_s, parameters, settings.reverse)
        start = settings.safe_output if self._mode is Mode.OFF else manual_output
        self._mv = min(max(start, settings.mv_low), settings.mv_high)

    @property
    def mode(self) -> Mode:
        return self._mode

    @property
    def mv(self) -> float:
        return self._mv

    @property
    def lease(self) -> int:
        """Samples left; 0: no session."""
        return self._lease

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
        if self._relay is not None:
            self._watch_relay(self._relay, pv)
        if self._settings.measured(pv):
            if self._pv is None:
                self._pid.rebase(self._setpoint, pv, self._mv)
            self._pv = pv
            self._mv = self._answer(pv)
        else:
            self.bad_samples += 1
            if self._mode is Mode.MANUAL or self._mode is Mode.OFF:
                self._mv = self._answer(pv)
        if self._lease:
            self._lease -= 1
            if not self._lease:
                self.go_back(Cause.LEASE)
        return self._mv

    def command_mode(self, mode: Mode | int) -> None:
        """OFF, MANUAL (at the present output) or AUTOMATIC; an experiment starts by `start_relay` only."""
        mode = Mode(mode)
        if mode is self._mode:
            return
        if mode is Mode.EXPERIMENT:
            raise ValueError("an experiment is started with its parameters, not by a mode")
        if self._mode is Mode.EXPERIMENT:
            self.experiment_state = ExperimentState.DONE
        self._enter(mode)
        if mode is Mode.MANUAL:
            self._manual_output = self._mv

    def stage(self, parameters: Parameters) -> None:
        self.staged = parameters

    def try_staged(self) -> None:
        """The staged set goes on trial, all of it in one sample."""
        self.on_trial = True
        if self.staged != self.in_effect:
            self._use(self.staged)

    def accept(self) -> None:
        """The set in effect becomes the one to come back to."""
        self.accepted = self.in_effect
        self.on_trial = False
        self.accept_count += 1

    def start_relay(
        self,
        amplitude: float,
        hysteresis: float,
        working_output: float,
        parallel_gain: float,
        max_samples: int,
        pv_low: float,
        pv_high: float,
        amplitude_low: float = 0.0,
        average: int = 1,
    ) -> None:
        """MV = working_output +- amplitude + parallel_gain*e, within the limits. MV units; hysteresis in PV units.

        amplitude_low: of the lower side, 0 for the same.  average: the mean error of so many samples switches the
        relay, up at e >= hysteresis and down at e <= -hysteresis (below 0 without hysteresis). It begins high unless
        that would switch it, a running one on the side it is on, and ends by itself when PV leaves pv_low..pv_high or
        after max_samples.
        """
        _finite(amplitude, hysteresis, working_output, parallel_gain, pv_low, pv_high, amplitude_low)
        if amplitude <= 0 or hysteresis < 0 or max_samples <= 0 or pv_low >= pv_high:
            raise ValueError("a relay needs amplitude > 0, hysteresis >= 0, max_samples > 0 and pv_low < pv_high")
        if amplitude_low < 0 or not 1 <= average <= MOST_AVERAGED:
            raise ValueError(f"a relay's low amplitude must be >= 0, its average 1 .. {MOST_AVERAGED} samples")
        error = 0.0 if self._pv is None else self._error(self._pv)
        high, errors = error > -hysteresis or error >= 0, deque([error], average)
        if self._relay is not None:
            high, errors = self._relay.high, deque(self._relay.errors, average)
        if self._mode is not Mode.EXPERIMENT:
            self._mode_after_relay = self._mode
        self._relay = _Relay(
            amplitude,
            hysteresis,
            working_output,
            parallel_gain,
            max_samples,
            pv_low,
            pv_high,
            high,
            amplitude_low or amplitude,
            errors,
        )
        self._mode = Mode.EXPERIMENT
        self.experiment_state = ExperimentState.RUNNING

    def renew_lease(self, samples: int) -> None:
        """samples > 0: that many are paid for, and a session opens if none is open.

        0 closes the session: trial and experiment end with it, mode, set-point and manual output stay as they are.
        """
        if samples < 0:
            raise ValueError("a lease must not be negative")
        if samples and self._session is None:
            mode = self._mode_after_relay if self._mode is Mode.EXPERIMENT else self._mode
            self._session = _Latched(mode, self._setpoint, self._manual_output)
        if not samples:
            self._session = None
            if self._mode is Mode.EXPERIMENT:
                self.experiment_state = ExperimentState.DONE
                self._enter(self._mode_after_relay)
            if self.on_trial:
                self.on_trial = False
                self._use(self.accepted)
        self._lease = samples

    def go_back(self, cause: Cause) -> None:
        """Ends trial, experiment and session: the accepted set, and what the session had noted."""
        self.cause = Cause(cause)
        self.on_trial = False
        mode = self._mode_after_relay if self._mode is Mode.EXPERIMENT else self._mode
        if self._mode is Mode.EXPERIMENT:
            self.experiment_state = ExperimentState.ENDED_BY_LIMIT if cause == Cause.PV_LIMIT else ExperimentState.DONE
        if self._session is not None:
            mode = self._session.mode
            self._setpoint = self._session.setpoint
            self._manual_output = self._session.manual_output
        self._session = None
        self._lease = 0
        self.in_effect = self.accepted
        self._enter(mode)

    def _enter(self, mode: Mode) -> None:
        self._relay = None
        self._mode = mode
        self._use(self.in_effect)

    def _use(self, parameters: Parameters) -> None:
        """This law from the present output on."""
        self.in_effect = parameters
        self._pid = Pid(self._sample_time_s, parameters, self._settings.reverse)
        if self._pv is not None:
            self._pid.rebase(self._setpoint, self._pv, self._mv)

    def _error(self, pv: float) -> float:
        return self._setpoint - pv if self._settings.reverse else pv - self._setpoint

    def _watch_relay(self, relay: _Relay, pv: float) -> None:
        """Ends the relay when its time is up or PV is out of bounds; a PV that is no number is not out of bounds."""
        if relay.samples_left == 0:
            self.go_back(Cause.PV_LIMIT)
            self.experiment_state = ExperimentState.DONE
        elif pv < relay.pv_low or pv > relay.pv_high:
            self.go_back(Cause.PV_LIMIT)
            self.experiment_state = ExperimentState.ENDED_BY_LIMIT
        else:
            relay.samples_left -= 1

    def _answer(self, pv: float) -> float:
        """The output this mode wants for this PV, within limits and rate."""
        settings = self._settings
        low, high = settings.mv_low, settings.mv_high
        if settings.rate_limit_per_s and self._mode is not Mode.OFF:
            reach = settings.rate_limit_per_s * self._sample_time_s
            # The limits win over the rate when they have been moved away from the present output.
            low, high = min(max(low, self._mv - reach), high), max(min(high, self._mv + reach), low)
        if self._mode is Mode.AUTOMATIC:
            return self._pid.step(self._setpoint, pv, low, high)
        if self._relay is not None:
            wanted = self._swing(self._relay, self._error(pv))
        elif self._mode is Mode.MANUAL:
            wanted = self._manual_output
        else:
            wanted = settings.safe_output
        return low if wanted < low else high if wanted > high else wanted

    @staticmethod
    def _swing(relay: _Relay, error: float) -> float:
        relay.errors.append(error)
        mean = sum(relay.errors) / len(relay.errors)
        if mean >= relay.hysteresis:
            relay.high = True
        elif mean <= -relay.hysteresis:
            relay.high = False
        swing = relay.amplitude if relay.high else -relay.amplitude_low
        return relay.working_output + swing + relay.parallel_gain * error


def _finite(*values: float) -> None:
    if not all(math.isfinite(value) for value in values):
        raise ValueError("values must be finite")
