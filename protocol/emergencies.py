"""The errors of a device, reported by EMCY, in the error register (1001h) and in the error history (1003h)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from loopwright.protocol.object_dictionary import Dictionary
from loopwright.protocol.objects import Value, lookup
from loopwright.protocol.profile import EMCY_FRAME, EMCY_REGISTER, Abort, Emcy
from loopwright.protocol.sdo import SdoAbort

_MAX_REMEMBERED = len(lookup("error_field").names)
_MAX_UNSENT = 32


class Emergencies:
    """Keeps the present errors of a device, each with its source: two sources may have the same error.

    send: function that sends an EMCY frame.
    """

    def __init__(self, dictionary: Dictionary, send: Callable[[bytes], None]) -> None:
        self._send = send
        self._errors: list[tuple[Emcy, bytes]] = []
        self._history: list[int] = []
        self._unsent: deque[bytes] = deque(maxlen=_MAX_UNSENT)
        """The EMCY frames that the bus has not taken yet."""
        dictionary.on_read["error_register"] = lambda sub: self._register()
        dictionary.on_read["error_field"] = self._read_history
        dictionary.on_write["error_field"] = self._write_history

    def raise_error(self, code: Emcy, detail: bytes = b"", source: bytes | None = None) -> None:
        """Reports an error once per occurrence; a lasting error is not repeated until `clear_error`.

        The source is the first byte of `detail`, a channel or a node, unless another is given. The same error of
        another source is reported too: the tuner of channel 2 must not miss its error because channel 1 has the same
        one.
        """
        error = code, detail[:1] if source is None else source
        if error in self._errors:
            return
        self._errors.append(error)
        self._history = [int(code), *self._history][:_MAX_REMEMBERED]
        self._send_after_the_unsent(EMCY_FRAME.pack(code, EMCY_REGISTER[code], detail[:5]))

    def clear_error(self, code: Emcy, source: bytes | None = None) -> None:
        """Ends the error of one source, or of all, and reports it by EMCY 0000h with the register of the remaining
        errors."""
        left = [error for error in self._errors if error[0] != code or source not in (None, error[1])]
        if len(left) < len(self._errors):
            self._errors = left
            self._send_after_the_unsent(EMCY_FRAME.pack(Emcy.ERROR_GONE, self._register(), b""))

    def _send_after_the_unsent(self, frame: bytes) -> None:
        self._unsent.append(frame)
        self.send_unsent()

    def send_unsent(self) -> None:
        """Sends the EMCY frames that the bus has not taken before. Raises BusError when it does not take one now."""
        while self._unsent:
            self._send(self._unsent[0])
            self._unsent.popleft()

    def sources(self, code: Emcy) -> list[bytes]:
        """Returns the sources of the errors with this code that are not cleared."""
        return [source for each, source in self._errors if each is code]

    def forget(self) -> None:
        """Drops all errors as at power-on, without sending an EMCY."""
        self._errors.clear()
        self._history.clear()
        self._unsent.clear()

    def _register(self) -> int:
        register = 0
        for code, _ in self._errors:
            register |= EMCY_REGISTER[code]
        return register

    def _read_history(self, sub: int) -> Value:
        if sub == 0:
            return len(self._history)
        if sub > len(self._history):
            raise SdoAbort(Abort.NO_DATA)
        return self._history[sub - 1]

    def _write_history(self, sub: int, value: Value) -> None:
        if value != 0:
            raise SdoAbort(Abort.INVALID_VALUE)
        self._history.clear()
