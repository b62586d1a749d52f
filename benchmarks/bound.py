"""What a record can tell of Ms at best: the Cramer-Rao bound, beside the errors that the procedures make.

    python -m benchmarks.bound [--seeds N]

The three plants of the benchmark of trouble, without trouble, 1 % noise. The bound is that of an unbiased estimate from
the same MV: the structure of the plant and the noise are known, its parameters and the level of PV are not. An error is
that of Ms of the gains designed, on the true plant, against the Ms that was asked for. Each figure is an rms over the
seeds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from benchmarks.cases import ASKED
from benchmarks.command import parser_of
from benchmarks.plants import Plant
from benchmarks.trouble.kinds import TROUBLES
from benchmarks.trouble.plants import trouble_plants
from benchmarks.trouble.runs import run_of
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.design.design import frequencies
from loopwright.tuning.fast.design.uncertainty import distance_from_instability, filter_ratio, seen_covariance
from loopwright.tuning.fast.evaluation.proposal import EvaluationSummary
from loopwright.tuning.fast.pulses.procedure import SETPOINT
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.relay.procedure import FAST
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import UNDISTURBED, Fit
from loopwright.tuning.identification.sensitivity import sensitivities
from loopwright.tuning.identification.structures import FIRST, SECOND
from loopwright.tuning.models import time_constants
from loopwright.tuning.plan import Event, StageDone

NO_TROUBLE = TROUBLES["none: linear"]
DESIGNED = {"design": "the excitation alone", "redesign": "with the step under the new gains"}
"""The stages that design gains, and the record that they have."""
HEAD = (
    "| plant | procedure | record | length, Pu | error of Ms | the bound | error / bound |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)


@dataclass(frozen=True, slots=True)
class Known:
    """What one record shows. length: Pu.  error: of Ms.  bound: one standard deviation of Ms."""

    plant: str
    method: str
    stage: str
    length: float
    error: float
    bound: float


def bound(record: ExperimentRecord, plant: Plant, gains: Gains, noise: float) -> float:
    """The smallest standard deviation of Ms of these gains that an unbiased estimate from this MV can have.

    record: its PV serves as the scale alone.  noise: the standard deviation of white noise on PV.
    Source: the Cramer-Rao inequality, with the information of the parameters at the true plant, by the delta method.
    """
    fit = Fit(record)
    rates = plant.Ts / time_constants(plant.model())
    structure = FIRST if len(rates) == 1 else SECOND
    logs = np.log([float(np.sum(rates)), float(np.prod(rates))][: structure.lags])
    true = fit.fitted(structure, UNDISTURBED, np.append(logs, plant.L / plant.Ts))
    variance = (noise / record.output_range) ** 2 / fit.block
    covariance = seen_covariance(sensitivities(fit, true), variance)[: structure.searched + structure.inputs]
    w = frequencies(plant.Pu)
    distance, along = distance_from_instability(fit, true, gains, w, filter_ratio(gains), record.sampling_delay_s)
    worst = int(np.argmin(distance))
    slopes = along[:, worst]
    sigma = math.sqrt(float(slopes @ covariance[:, : len(slopes)] @ slopes))
    return sigma / float(distance[worst]) ** 2


def records(plant: Plant, method: str, seed: int) -> Iterator[Known]:
    """What each design of one run knew."""
    designed: dict[str, Gains] = {}

    def heard(event: Event) -> None:
        if isinstance(event, StageDone) and isinstance(event.result, EvaluationSummary):
            designed[event.stage] = event.result.gains

    result, loop = run_of(plant, method, NO_TROUBLE, seed, heard)
    record = loop.record()
    if record is None or result.value is None:
        return
    noise = loop.plant.noise
    for stage, gains in designed.items():
        end = record.excited if stage == "design" else len(record.y)
        seen = replace(record, u=record.u[:end], y=record.y[:end], steps=record.steps if end > record.excited else ())
        length = (end - record.listened) * plant.Ts / plant.Pu
        error = margins(plant.model(), gains).Ms - ASKED
        yield Known(plant.name, method, stage, length, error, bound(seen, plant, gains, noise))


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="so many (default: %(default)s)")
    given = parser.parse_args()
    print(HEAD)
    for plant, method in product(trouble_plants(), (FAST, SETPOINT)):
        found = [each for seed in range(1, given.seeds + 1) for each in records(plant, method, seed)]
        for stage, words in DESIGNED.items():
            mine = [each for each in found if each.stage == stage]
            if not mine:
                continue
            error, least = (math.sqrt(float(np.mean(np.square(values)))) for values in (
                [each.error for each in mine], [each.bound for each in mine],
            ))  # fmt: skip
            length = float(np.median([each.length for each in mine]))
            figures = f"{length:.1f} | {error:.4f} | {least:.4f} | {error / least:.1f}"
            print(f"| {plant.name} | {method} | {words} | {figures} |")


if __name__ == "__main__":
    main()
