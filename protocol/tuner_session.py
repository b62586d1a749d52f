"""The tuner's side of a session: opening it, giving its orders, renewing and closing it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

from loopwright.protocol.objects import Value, lookup
from loopwright.protocol.profile import Abort, Order
from loopwright.protocol.session import STAGED, check_of, object_of
from loopwright.protocol.tuner import Tuner, TunerError


@dataclass(frozen=True, slots=True)
class Lease:
    """The terms of a session, in samples and in ms of the controller's clock (`controller.session.Terms`)."""

    samples: int
    ms: int
    pv_silence_ms: int
    watch_ms: int


class TunerSession:
    """A session on the channel of one tuner. Every method raises TunerError, of kind ABORT where the controller
    refuses."""

    def __init__(self, tuner: Tuner) -> None:
        self.number = 0
        """The number of the session opened or taken up last; 0 for none yet."""
        self._tuner = tuner
        self.count = 0
        self.staged: dict[str, Value] = {}

    def open(self, lease: Lease, note_session: Callable[[int], None]) -> None:
        """Opens a session.

        lease: its terms.
        note_session: stores the number before the opening is sent, so that a later process can close the session.
        """
        for last_try in (False, False, True):
            number = int(self._tuner.number("controller_session_next"))
            note_session(number)
            self.number, self.count = number, 0
            self.staged.clear()
            try:
                self.give(Order.OPEN, (self._tuner.station.node, *astuple(lease)))
                return
            except TunerError as error:  # another tuner has opened a session or staged values at the same time
                if last_try or error.code != Abort.INVALID_VALUE:
                    raise

    def take_up(self, number: int) -> None:
        """Continues a session that was opened before, by this process or by one that has died."""
        self.number = number
        self.count = int(self._tuner.number("controller_session_count"))
        self.staged.clear()

    def give(self, order: Order, values: Sequence[Value] = ()) -> None:
        """Stages the values that are not staged yet and puts the order in force."""
        try:
            self._give(order, values)
        except TunerError as error:
            if error.code != Abort.INVALID_VALUE or order is Order.OPEN:
                raise
            # Another master has staged other values, or the answer to an order in force was lost.
            self.take_up(self.number)
            self._give(order, values)

    def _give(self, order: Order, values: Sequence[Value]) -> None:
        sent = []
        for name, value in zip(STAGED[order], values, strict=True):
            entry = lookup(name).type
            sent.append(entry.decode(entry.encode(value)))
            if self.staged.get(name) != sent[-1]:
                self._tuner.write(name, float(value))
                self.staged[name] = sent[-1]
        self._tuner.write(object_of(order), check_of(self.number, self.count, order, sent))
        self.count += 1

    def renew(self) -> None:
        """Renews the lease."""
        self._tuner.write("controller_session_renewal", self.number)

    def close(self) -> None:
        """Closes the session."""
        self.give(Order.CLOSE)

    @property
    def is_open(self) -> bool:
        """Returns whether the controller says that the session is open."""
        return self.number != 0 and int(self._tuner.number("controller_session")) == self.number
