"""The connection to one loop on a bus: it opens the tuner when needed, and turns bus errors into reasons."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from loopwright.protocol.bus import BusError
from loopwright.protocol.profile import Abort, NmtState, node_name
from loopwright.protocol.station import NodeTaken, Station
from loopwright.protocol.tuner import FailureKind, Tuner, TunerError
from loopwright.service.loops.bus_reading import BusReading, not_operational, state_name
from loopwright.tuning.reasons import Failed, Reason, Refused

AGAIN_S = 0.05
"""Wall time between two tries of a request that a controller does not fulfil at once, s."""

_NOT_OURS = (Abort.NO_OBJECT, Abort.LENGTH, Abort.READ_ONLY, Abort.WRITE_ONLY)

Read = Callable[[Tuner, int, int | None, int], BusReading]


class BusConnection:
    """Connects to one channel of a controller node.

    plant: node-ID of the plant I/O; None where it cannot be asked.
    station: this process on the bus.
    read: makes the readings; a simulation records them.
    """

    def __init__(
        self, url: str, controller: int, plant: int | None, channel: int, station: Station, read: Read = BusReading
    ) -> None:
        self.url = url
        self.controller = controller
        self.plant = plant
        self.channel = channel
        self.station = station
        self._read = read
        self._tuner: Tuner | None = None

    @contextmanager
    def tuner(self) -> Iterator[Tuner]:
        """Yields the tuner, opened when it is needed; errors of the bus are raised as Failed or Refused."""
        try:
            if self._tuner is None:
                self._tuner = Tuner(self.url, self.controller, self.plant, self.channel, station=self.station)
            yield self._tuner
        except NodeTaken as error:
            raise Refused(Reason.LOOP_IN_USE, str(error)) from error
        except BusError as error:
            self.close()
            raise Failed(Reason.BUS_LOST, str(error)) from error
        except OSError as error:  # an interface may disappear between two calls
            self.close()
            text = f"bus {self.url!r} is lost ({error.strerror or error}): see that its interface is there and up"
            raise Failed(Reason.BUS_LOST, text) from error
        except TunerError as error:
            if error.kind is FailureKind.TIMEOUT:
                raise self._no_answer(error) from error
            if error.code == Abort.NO_SUBINDEX:
                node = f"controller node {node_name(self.controller)}"
                text = f"{node} has no channel {self.channel}, says the device: {error}"
                raise Refused(Reason.DEVICE_MISMATCH, f"{text}; see the channel in loops.yaml") from error
            if error.code in _NOT_OURS:
                raise self._mismatch(error) from error
            raise Refused(Reason.BAD_INPUT, f"the controller refused: {error}") from error

    def reading(self, tuner: Tuner) -> BusReading:
        """Returns a reading of the channel through this tuner."""
        return self._read(tuner, self.controller, self.plant, self.channel)

    def stop_beating(self) -> None:
        """Ends this process's heartbeat for the loop and the renewals of the lease."""
        if self._tuner is not None:
            self._tuner.beating = False
            self._tuner.set_renewed_session(0)

    def close(self) -> None:
        """Closes the tuner; it is opened again when needed."""
        if self._tuner is not None:
            self._tuner.close()
            self._tuner = None

    def _mismatch(self, error: TunerError) -> Refused:
        """Returns the error for a node that is not the expected device: what it is, where it says so."""
        try:
            assert self._tuner is not None
            self.reading(self._tuner).identify_controller()
        except Refused as what_it_is:
            return what_it_is
        except (TunerError, BusError, OSError, Failed):
            pass
        return Refused(Reason.DEVICE_MISMATCH, str(error))

    def _no_answer(self, error: TunerError) -> Failed:
        """Distinguishes a node that sends heartbeats and answers no SDO, in the state stopped or another, from one that
        is gone."""
        states = self._tuner.node_states if self._tuner is not None else {}
        for node in (self.controller, self.plant):
            if node is not None and states.get(node) == NmtState.STOPPED:
                return not_operational(node, NmtState.STOPPED)
        if self._tuner is not None and self._tuner.beats(error.node):
            state = state_name(states.get(error.node, NmtState.OPERATIONAL))
            text = f"{error}, and beats: its heartbeat is heard ({state})"
            return Failed(Reason.NODE_NOT_ANSWERING, text)
        return Failed(Reason.NODE_LOST, str(error))
