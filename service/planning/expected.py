"""How far a retune is expected to move PV, and the model that it is known by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from loopwright.tuning.models import Model


@dataclass(frozen=True, slots=True)
class LoopModel:
    """A model of the loop's plant before a test.

    model: without the delay of the sampling.
    source: where it comes from, in words.
    covariance: of num, of den without its leading 1 and of the dead time, in this order; None where it is not known.
    noise: the standard deviation of PV's noise, PV units; None where it is not known.
    rough: whether its gain is known to a factor of two alone.
    """

    model: Model
    source: str
    covariance: tuple[tuple[float, ...], ...] | None = None
    noise: float | None = None
    rough: bool = False


@dataclass(frozen=True, slots=True)
class Reach:
    """How far PV goes from where it rests, its noise included, PV units; down and up are positive.

    down, up: at most, with the uncertainty of the model.
    likely_down, likely_up: on the model itself.
    """

    down: float
    up: float
    likely_down: float
    likely_up: float

    @property
    def farthest(self) -> float:
        """The larger of the two sides, at most."""
        return max(self.down, self.up)


@dataclass(frozen=True, slots=True)
class ExpectedPv:
    """What a retune is expected to do to PV.

    source: the model that tells it, in words; empty where nothing does.
    stages: how far PV goes in each stage; a stage that is not in it is one of which that is not known.
    begins_with_pct: the amplitude with which the relay begins so that PV keeps its limits, percent; None where it may
    begin with its own.
    broken: a sentence with the numbers for each limit of PV that the test is expected to break all the same.
    """

    source: str = ""
    stages: Mapping[str, Reach] = field(default_factory=dict)
    begins_with_pct: float | None = None
    broken: tuple[str, ...] = ()


NOTHING_EXPECTED = ExpectedPv()
