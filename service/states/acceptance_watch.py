"""The watch of a loop after gains were accepted, as it is stored: what was compared, and what came of it. Pure."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum

from pydantic import BaseModel, ConfigDict

from loopwright.tuning.operation.change_findings import ChangeState, ComparedChange, DifferenceKind, OtherPlant
from loopwright.tuning.operation.model_conclusion import Conclusion, ModelState, conclusion_of

CHANGES = 3
"""Number of changes that are compared."""
PERIODS = 10.0
"""Ultimate periods for which the loop is watched at least."""
MAX_CHANGES = 12
"""Number of changes after which the watch ends, whatever they tell."""


class WatchEnd(StrEnum):
    """Why a watch has ended; the value is what the API shows and the database holds."""

    COMPLETE = "complete"
    GAINS_CHANGED = "gains_changed"
    RETUNED = "retuned"
    ROLLED_BACK = "rolled_back"
    TOO_LONG = "too_long"


class TroubleKind(StrEnum):
    """What goes wrong. For a false PV no gains are put back: nothing is to be done by what it shows."""

    PV_OUTSIDE_LIMITS = "pv_outside_limits"
    GROWING_OSCILLATION = "growing_oscillation"
    FALSE_PV = "false_pv"


class _Kept(BaseModel):
    model_config = ConfigDict(frozen=True)


class WatchedChange(_Kept):
    """A change that was compared. at_s: its first move, wall time, seconds since 1970 UTC."""

    at_s: float
    compared: ComparedChange


class Trouble(_Kept):
    """What went wrong under the accepted gains.

    at: when it was seen: UTC, ISO 8601. text: in words, with the numbers.
    rolled_back: whether the previous gains were put back for it by the watch; None: that is not decided yet.
    reason: why they were not, in words; None: they were, or it is not decided yet.
    """

    kind: TroubleKind
    at: str
    text: str
    rolled_back: bool | None = None
    reason: str | None = None


class AcceptanceWatch(_Kept):
    """The watch of one acceptance.

    since: when the gains were accepted, or a clock was set back behind that: UTC, ISO 8601. by: who has accepted them.
    latest_job: the latest job of the loop as they were accepted.
    auto_rollback: whether the previous gains are to be put back where something goes wrong.
    inside: whether PV was within its limits since then: one that never was does not leave them.
    auto_rollback_off: why they are not put back any more, in words; None: they are, if that was asked for.
    period_s: the ultimate period of the model, s.
    model: why the loop is compared with no model, in words; None: it is compared.
    changes: those that were compared, oldest first. looked_to_s: up to when changes were looked for, wall time, s.
    no_data: why the loop is not heard at present, in words; None: it is.
    trouble: what went wrong; None: nothing.
    end, ended_at: why and when it ended; None: it goes on.
    """

    since: str
    by: str
    latest_job: str | None = None
    auto_rollback: bool
    period_s: float
    model: str | None = None
    inside: bool = False
    auto_rollback_off: str | None = None
    changes: tuple[WatchedChange, ...] = ()
    looked_to_s: float = 0.0
    no_data: str | None = None
    trouble: Trouble | None = None
    end: WatchEnd | None = None
    ended_at: str | None = None

    @property
    def since_s(self) -> float:
        """Since when what is heard counts, wall time, s."""
        return datetime.fromisoformat(self.since).timestamp()

    @property
    def armed(self) -> bool:
        """Whether the previous gains are put back automatically where something goes wrong now."""
        return self.auto_rollback and self.auto_rollback_off is None and self.end is None and self.trouble is None

    @property
    def informative(self) -> int:
        """The number of changes that tell something of the model."""
        return sum(each.compared.state in (ChangeState.CONFIRMED, ChangeState.DIFFERS) for each in self.changes)

    def conclusion(self) -> Conclusion:
        """What the changes say of the model together."""
        return conclusion_of([each.compared for each in self.changes])

    @property
    def alarm(self) -> bool:
        """Whether an alarm is to be made of what was found. Who has rolled back has seen it; what the watch has rolled
        back by itself nobody has seen yet."""
        if self.trouble is not None and self.trouble.rolled_back:
            return True
        found = self.trouble is not None or self.conclusion().state is ModelState.MISMATCH
        return found and self.end is not WatchEnd.ROLLED_BACK

    @property
    def message(self) -> str:
        """What the watch has come to, in a sentence or two."""
        found = self.conclusion()
        parts = [_words_of(found, self)]
        if self.trouble is not None:
            parts.append(_words_of_trouble(self.trouble))
        if self.no_data is not None and self.end is None:
            parts.append(f"No data of the loop: {self.no_data}.")
        return " ".join(parts)


def _words_of(found: Conclusion, watch: AcceptanceWatch) -> str:
    if watch.model is not None:
        return f"Nothing is compared: {watch.model}."
    if found.state is ModelState.MISMATCH and found.instead is not None:
        return (
            f"The plant is not the one of the model: {instead_in_words(found.instead)}, as {found.changes} set-point "
            f"changes show. Ms is {found.instead.Ms:.2f} then."
        )
    if found.state is ModelState.CONFIRMED:
        return f"The model is confirmed by {found.confirmed} change{'s' * (found.confirmed != 1)} of normal operation."
    if not watch.changes:
        return "Nothing has moved the loop yet since the gains were accepted." if watch.end is None else (
            "Nothing has moved the loop while it was watched: the model is neither confirmed nor disproved."
        )  # fmt: skip
    count = len(watch.changes)
    if found.confirmed or watch.informative:
        return (
            f"The latest change does not fit the model, which {found.confirmed} of {count} changes confirm; a load, or "
            "a plant that changes, looks like that. The next change will tell."
        )
    return (
        f"{count} change{'s' * (count != 1)} of normal operation neither confirm{'s' * (count == 1)} nor "
        f"disprove{'s' * (count == 1)} the model: too small, or disturbed."
    )


def instead_in_words(found: OtherPlant) -> str:
    """What fits instead of the model, with two standard deviations."""
    spread = 2.0 * found.deviation
    if found.kind is DifferenceKind.GAIN:
        return f"its gain is {1.0 + found.size:.2f} +- {spread:.2g} times that of the model"
    if found.kind is DifferenceKind.DEAD_TIME:
        later = "longer" if found.size > 0.0 else "shorter"
        return f"its dead time is {abs(found.size):.3g} +- {spread:.2g} s {later}"
    return (
        f"a second path acts {found.delay_s:.3g} s later, with {100.0 * found.size:.0f} +- {100.0 * spread:.2g} % of "
        "the gain of the model"
    )


def _words_of_trouble(trouble: Trouble) -> str:
    if trouble.rolled_back:
        return f"{trouble.text}: the previous gains were put back."
    if trouble.reason is None:
        return f"{trouble.text}."
    return f"{trouble.text}. The previous gains were not put back: {trouble.reason}."
