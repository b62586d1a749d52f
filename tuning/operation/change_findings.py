"""What one change of operation says of the accepted model."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class DifferenceKind(StrEnum):
    """What may differ from the model."""

    GAIN = "gain"
    DEAD_TIME = "dead_time"
    SECOND_PATH = "second_path"


class ChangeState(StrEnum):
    """What one change says of the model."""

    CONFIRMED = "confirmed"
    DIFFERS = "differs"
    DISTURBED = "disturbed"
    NOT_ENOUGH = "not_enough_excitation"


@dataclass(frozen=True, slots=True)
class OtherPlant:
    """What may be there instead of the model.

    delay_s: by how much a second path acts later, s; 0 for other kinds.
    size: the gain less that of the model, or the share of the second path, as fractions of the gain of the model; the
    further dead time, s.
    deviation: the standard deviation of the size.
    residual: the rms of the residual with it, in standard deviations of the noise.
    Ms: Ms of the accepted gains with it.
    clear: whether the change shows it, of a size that matters.
    """

    kind: DifferenceKind
    delay_s: float
    size: float
    deviation: float
    residual: float
    Ms: float
    clear: bool


@dataclass(frozen=True, slots=True)
class ComparedChange:
    """One change compared with the model.

    size: the largest deviation of the set-point from before, PV units; 0 of a load.
    residual: the rms of what the model leaves of PV, in standard deviations of the noise.
    load: whether a load has moved PV, or a step of it explains what the model leaves.
    alternatives: what may be there instead: another gain, another dead time, and the second paths that are clear.
    """

    state: ChangeState
    size: float
    residual: float
    load: bool
    alternatives: tuple[OtherPlant, ...]

    @property
    def best(self) -> OtherPlant | None:
        """The alternative that the change shows and that explains it best; None where it shows none."""
        return min((each for each in self.alternatives if each.clear), key=lambda each: each.residual, default=None)
