"""This service's session on a channel: its opening, its terms and its supervision; `bus_restore` ends it.

The session belongs to the controller (`controller.session`, decision 8). When the service hangs or dies, the session
ends, and the controller itself restores the loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from loopwright.protocol.profile import FOREVER, Abort, Order, node_name
from loopwright.protocol.tuner import FailureKind, Tuner, TunerError
from loopwright.protocol.tuner_session import Lease, TunerSession
from loopwright.service.loops.bus_connection import AGAIN_S, BusConnection
from loopwright.service.loops.bus_endings import why_over
from loopwright.service.loops.bus_reading import order_unknown
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.reasons import Ended, Reason, Refused

WATCH_S = 1.5
"""Time of the controller's clock without a heartbeat of this service, or without PV (at least three sampling periods),
after which the controller ends the session, s. Virtual machines were seen to stand still for 1.3 s."""
LEASE_WALL_S = 3.0
"""Lease where the plant's clock drives the samples, s of the controller's clock."""
LEASE_IN_BLOCKS_S = 30.0
"""Lease where the plant is run in blocks, s of the controller's clock."""
CONFIRM_S = 10.0
"""Wall time between two questions to the controller whether the session is still open, s: each is an SDO, which has to
wait for the node's lock."""
PV_SILENCE_IN_BLOCKS_S = 60.0
"""Permitted time without PV where the plant is run in blocks, s: a held plant sends none, and a block may wait for a
computation."""
OTHERS_S = LEASE_WALL_S + 1.0
"""Longest wait for the end of another tuner's session before the opening, s."""
SHORTEST_LEASE = 20
"""Shortest lease, in samples."""


def terms(pace: float, sample_time_s: float) -> Lease:
    """Returns the terms of a session. At pace 0 the number of samples says nothing about time."""
    if not pace:
        samples, lease_s, silence_s = FOREVER, LEASE_IN_BLOCKS_S, PV_SILENCE_IN_BLOCKS_S
    else:
        samples, lease_s = math.ceil(LEASE_WALL_S * pace / sample_time_s), LEASE_WALL_S
        silence_s = max(WATCH_S, 3.0 * sample_time_s / pace)
    ms = (math.ceil(1000.0 * wait_s) for wait_s in (lease_s, silence_s, WATCH_S))
    return Lease(min(max(samples, SHORTEST_LEASE), FOREVER), *ms)


class BusSession:
    """Opens and supervises this service's session on the channel of a connection.

    check_stop_request: called in every wait with its description; raises when the job is asked to stop.
    """

    def __init__(self, connection: BusConnection, check_stop_request: Callable[[str], None]) -> None:
        self.number = 0
        """The number of the session opened last; 0 for none."""
        self.confirmed_at = 0.0
        """Time on the station's clock at which the controller last confirmed that the session is open, s."""
        self._connection = connection
        self._station = connection.station
        self._check_stop_request = check_stop_request
        self._session: TunerSession | None = None
        self._lease = Lease(SHORTEST_LEASE, 1, 1, 1)

    # -- the opening

    def open(
        self,
        tuner: Tuner,
        pace: float,
        sample_time_s: float,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        """Opens the session and returns the state before the test.

        note_session: stores the session's number before it is opened.
        """

        def note(number: int) -> None:
            note_session(number)
            self.number = number

        self._wait_for_others(tuner)
        # The heartbeat starts only now: it would keep the session of a dead process with this node-ID alive.
        tuner.start_heartbeat()
        self._session = TunerSession(tuner)
        self._lease = terms(pace, sample_time_s)
        try:
            self._session.open(self._lease, note)
        except TunerError as error:
            if error.kind is FailureKind.ABORT:  # no session was opened, so none has to be closed
                note(0)
            if error.code == Abort.LOCAL_CONTROL:
                text = "an RPDO has just moved the set-point: an outer loop, a ramp or a recipe drives it"
                raise Refused(Reason.SETPOINT_IS_DRIVEN, text) from error
            if error.code == Abort.DEVICE_STATE:
                raise self._in_use(tuner) from error
            raise
        self.confirmed_at = self._station.monotonic()
        tuner.set_renewed_session(
            self.number, lambda: self._check_stop_request("while other loops had their turn with the node")
        )
        tuner.restarted, tuner.session_is_open = False, True
        home = self._connection.reading(tuner).home()
        if tuner.session_is_open:  # else the session has ended already, as the status has reported
            tuner.mode, tuner.on_trial, tuner.sp = home.mode, False, home.sp
        return home

    def _wait_for_others(self, tuner: Tuner) -> None:
        """Waits for the end of another tuner's session: that of a dead tuner ends within its lease, that of a live one
        is not to be ended here. Raises Refused(LOOP_IN_USE)."""
        give_up = self._station.monotonic() + OTHERS_S
        while tuner.number("controller_session"):
            if self._station.monotonic() > give_up:
                raise self._in_use(tuner)
            self._check_stop_request("while another tuner held the loop")
            self._station.sleep(AGAIN_S)

    def _in_use(self, tuner: Tuner) -> Refused:
        self._connection.reading(tuner).check_controller_operational()
        holder = int(tuner.number("controller_session_holder"))
        if holder:
            text = f"the tuner with node-ID {node_name(holder)} holds a session on this loop"
            return Refused(Reason.LOOP_IN_USE, text)
        if tuner.number("controller_on_trial"):
            text = "an operator tries other gains by hand: accept them or take them back (2120h), then repeat"
            return Refused(Reason.GAINS_CHANGED, text)
        return Refused(Reason.LOOP_IN_USE, "another tuner had this loop at the moment of the opening")

    # -- during the session

    def order(self, tuner: Tuner, order: Order, *values: float) -> None:
        """Gives an order. Raises the reason why the session is over where that is why it is refused, else
        TunerError."""
        assert self._session is not None
        try:
            self._session.give(order, values)
        except TunerError as error:
            if error.code in (Abort.DEVICE_STATE, Abort.INVALID_VALUE) and not self._session.is_open:
                raise self.why_over(tuner) from error
            if error.code == Abort.NO_OBJECT:
                raise order_unknown(self._connection.controller, order) from error
            raise

    def confirm_if_due(self, tuner: Tuner) -> None:
        """Asks whether the session is still open: renewals are not answered, and a status frame that reports its end
        may be lost."""
        if self._station.monotonic() - self.confirmed_at < CONFIRM_S:
            return
        assert self._session is not None
        try:
            self._session.renew()
        except TunerError as error:
            if error.code == Abort.DEVICE_STATE:
                raise self.why_over(tuner) from error
            raise
        self.confirmed_at = self._station.monotonic()

    def check_status(self, tuner: Tuner) -> None:
        """Raises the reason why the session is over, where a status frame has reported it and the controller confirms
        it: a status frame from before the opening may come late."""
        if tuner.restarted or not tuner.session_is_open:
            tuner.restarted, tuner.session_is_open = False, True
            if not self.is_open(tuner):
                raise self.why_over(tuner)

    def is_open(self, tuner: Tuner) -> bool:
        """Asks the controller whether the session is open."""
        return int(tuner.number("controller_session")) == self.number

    def why_over(self, tuner: Tuner) -> Ended:
        """Returns why the session has ended without a request of this service."""
        tuner.set_renewed_session(0)
        return why_over(self._connection.reading(tuner), self.number, self._lease.pv_silence_ms / 1000.0)
