"""How a rehearsal ended, and its record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from loopwright.service.inputs.plant_file import RehearsedPlant
from loopwright.service.jsonable import to_jsonable
from loopwright.service.results import FastResult, FiveStageResult
from loopwright.tuning.analysis.notebook import as_html
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model
from loopwright.tuning.plan import Event, Sample, StageStarted
from loopwright.tuning.reasons import Ended, Failed, NoGain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Column = NDArray[np.float64]


@dataclass(eq=False)
class RehearsalRecord:
    """The samples of a rehearsal, as its events and samples come.

    stage: the stage that runs.  stages: the stage of each sample.  samples: the samples.
    """

    stage: str = "preflight"
    stages: list[str] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)

    def on_event(self, event: Event) -> None:
        """Notes the stage that begins; the samples of a stage that is done have come before."""
        if isinstance(event, StageStarted):
            self.stage = event.stage

    def on_samples(self, samples: Sequence[Sample]) -> None:
        """Takes samples of the present stage."""
        self.stages += [self.stage] * len(samples)
        self.samples += samples

    def __repr__(self) -> str:
        return f"Record of {len(self.samples)} samples: t, sp, pv, mv, stages"

    @property
    def t(self) -> Column:
        """The plant time of each sample, s, shape (N,)."""
        return np.array([sample.t for sample in self.samples])

    @property
    def sp(self) -> Column:
        """The set-point, PV units, shape (N,)."""
        return np.array([sample.sp for sample in self.samples])

    @property
    def pv(self) -> Column:
        """PV, PV units, shape (N,)."""
        return np.array([sample.pv for sample in self.samples])

    @property
    def mv(self) -> Column:
        """MV, MV units, shape (N,)."""
        return np.array([sample.mv for sample in self.samples])


@dataclass(frozen=True, repr=False)
class Rehearsal:
    """How a rehearsal ended.

    result: as far as it came.  ended: why there is no proposal, None where there is one.
    plant_time_s: the plant time of each stage, s.  stages: what each stage found.
    plant: the plant as completed, None for one that cannot be used.
    record: its samples; None where the caller took them.
    """

    result: FastResult | FiveStageResult
    ended: Ended | None
    plant_time_s: dict[str, float] = field(default_factory=dict)
    stages: dict[str, object] = field(default_factory=dict)
    plant: RehearsedPlant | None = None
    record: RehearsalRecord | None = None

    @property
    def gains(self) -> Gains | None:
        """The gains that are proposed; None where none are."""
        return None if self.ended is not None or self.result.new_gains is None else self.result.new_gains.gains()

    @property
    def model(self) -> Model | None:
        """The model that was found; None without one."""
        return None if self.result.model is None else self.result.model.process_model()

    def __repr__(self) -> str:
        name = "the plant" if self.plant is None else self.plant.name
        head = f"{self.result.method} on {name}"
        if self.ended is not None:
            return f"{head}: {_outcome(self.ended)}, {self.ended.reason.value}: {self.ended.detail}"
        predicted = "" if self.result.predicted is None else f"; Ms {self.result.predicted.Ms:.3g}"
        return f"{head}: {self.gains}{predicted}; {sum(self.plant_time_s.values()):.4g} s of plant time"

    def _repr_html_(self) -> str:
        """What a notebook shows: present and new gains, why there are none, and the record."""
        rows = [
            (name, f"{gains.Kp:.4g}", f"{gains.Ti:.4g}", f"{gains.Td:.4g}", f"{gains.b:.3g}")
            for name, gains in (("present", self.result.previous_gains), ("new", self.result.new_gains))
            if gains is not None
        ]
        notes = () if self.ended is None else (self.ended.advice,)
        draw = self.plot if self.record is not None and self.record.samples else None
        return as_html(repr(self), [("", "Kp", "Ti, s", "Td, s", "b"), *rows], notes, draw)

    def plot(self) -> Figure:
        """The picture of the record; needs matplotlib. Raises ValueError without a record."""
        from matplotlib.figure import Figure

        if self.record is None or not self.record.samples:
            raise ValueError(f"there is no record to draw: {self!r}")
        record, figure = self.record, Figure(figsize=(9, 5), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(record.t, record.sp, color="0.5", label="SP")
        above.plot(record.t, record.pv, label="PV")
        above.legend()
        below.step(record.t, record.mv, where="post")
        above.set_ylabel("PV")
        below.set(xlabel="plant time, s", ylabel="MV")
        return figure

    def as_json(self) -> dict[str, object]:
        """The object of `loopwright rehearse --json`: the result under the names of `GET /jobs/{id}`, and how it came
        about. What is not known is null."""
        ended = self.ended
        return {
            "name": None if self.plant is None else self.plant.name,
            "outcome": _outcome(ended),
            "reason": ended.reason.value if ended else None,
            "detail": ended.detail if ended else None,
            "advice": ended.advice if ended else None,
            **self.result.model_dump(mode="json"),
            "plant_time_s": {**self.plant_time_s, "total": sum(self.plant_time_s.values())},
            "stages": to_jsonable(self.stages),
            "input": None if self.plant is None else self.plant.model_dump(mode="json"),
        }


def _outcome(ended: Ended | None) -> str:
    if ended is None:
        return "proposed"
    return "no_gain" if isinstance(ended, NoGain) else "failed" if isinstance(ended, Failed) else "refused"
