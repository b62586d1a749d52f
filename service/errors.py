"""Wishes that cannot be met now, whoever asks and however."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import ClassVar

from loopwright.tuning.reasons import Failed, Reason, Refused

_ALIKE = 0.8
"""Ratio of difflib from which a tag is named as the one that may have been meant: one letter of five is wrong."""


class UnknownLoop(Exception):
    """No loop of that tag is configured.

    tags: the tags that there are; one that is written alike is named.
    """

    def __init__(self, tag: str, tags: Iterable[str] = ()) -> None:
        known = {_letters(each): each for each in tags}
        alike = get_close_matches(_letters(tag), known, 1, _ALIKE)
        super().__init__(f"there is no loop {tag}" + (f"; did you mean {known[alike[0]]}?" if alike else ""))
        self.tag = tag


def _letters(tag: str) -> str:
    """Returns the letters and digits of a tag, in one case."""
    return "".join(filter(str.isalnum, tag.casefold()))


class Stopping(Exception):
    """The service is shutting down and takes no new work."""


class Conflict(Exception):
    """The job or its loop is not in the state that the request needs."""


class GatewayLost(Failed):
    """The gateway of the loop does not answer: nothing was written, and nothing will be."""

    def __init__(self, detail: str) -> None:
        super().__init__(Reason.GATEWAY_LOST, detail)


class NotKnown(Exception):
    """What a decision or an abort has come to is not known; the text says how it becomes known."""


class _OfOneReason(Refused):
    """A refusal whose class says the reason."""

    of: ClassVar[Reason]

    def __init__(self, detail: str) -> None:
        super().__init__(self.of, detail)

    def __reduce__(self) -> tuple[type[_OfOneReason], tuple[str]]:  # type: ignore[override]
        return type(self), (self.detail,)


class Locked(_OfOneReason):
    """Somebody has locked the loop: no test begins on it, and no decision writes to it."""

    of = Reason.LOCKED


class NotAcknowledged(Locked):
    """A test has found PV of the loop to be false, and no person has acknowledged that: no test begins on it."""

    of = Reason.NOT_ACKNOWLEDGED


class RemoteSetpoint(_OfOneReason):
    """Another controller moves the set-point of the loop, so that the set-point cannot be pulsed."""

    of = Reason.SETPOINT_IS_DRIVEN


class LockedOtherwise(Locked):
    """Somebody has locked the loop for another reason."""
