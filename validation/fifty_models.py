"""What the five-stage paper says of its 50 plants and of its formulas, on the plants that can be read."""

from __future__ import annotations

import math
from statistics import mean, median

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.analysis.stability import is_stable
from loopwright.tuning.analysis.step_response import step_figures
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.overshoot import fopdt_from_overshoot
from loopwright.tuning.models import FOPDT
from validation import tolerances as tol
from validation.checks import Cell, Claim, Column, Row, Table
from validation.loops import FIVE_LAGS, plant
from validation.references import References


class FiftyModels:
    """The estimate by (2) to (5) in the place of each plant, both under the plant's Ziegler-Nichols PI."""

    def __init__(self, references: References) -> None:
        self.printed = references.more["five_stage"]
        self.plants = len(references.plants)
        self.unstable = 0
        self.untouched = 0
        self.worse: list[str] = []
        self.ratios: list[float] = []
        self.overshoots: list[float] = []
        for entry in references.plants:
            model = plant(entry)
            Ku, Pu = ultimate_point(model)
            zn = Gains(Ku / 2.2, Pu / 1.2)
            figures = step_figures(model, zn)
            Kp, overshoot = zn.Kp, figures.overshoot_pct
            # Stage 3: a tenth of the way to Ku at a time, until the overshoot is within its window
            while not 10.0 <= overshoot <= 50.0:
                Kp += math.copysign(0.1 * (Ku - zn.Kp), 30.0 - overshoot)
                overshoot = step_figures(model, Gains(Kp, zn.Ti)).overshoot_pct
            found = fopdt_from_overshoot(Kp, zn.Ti, overshoot)
            estimate = FOPDT(found.k5, found.T, found.L)
            if not is_stable(estimate, zn):
                self.unstable += 1
                continue
            other = step_figures(estimate, zn)
            assert figures.settling_s is not None and other.settling_s is not None
            self.ratios.append(other.settling_s / figures.settling_s)
            self.overshoots.append(other.overshoot_pct - figures.overshoot_pct)
            if Kp == zn.Kp:
                self.untouched += 1
                if other.IAE > 1.1 * figures.IAE:
                    self.worse.append(f"No. {entry['id']} by {100.0 * (other.IAE / figures.IAE - 1.0):.0f} %")

    def table(self) -> Table:
        Ku, Pu = ultimate_point(FIVE_LAGS)
        gains = Gains(Ku / 2.2, Pu / 1.2)
        found = fopdt_from_overshoot(gains.Kp, gains.Ti, step_figures(FIVE_LAGS, gains).overshoot_pct)
        ratio = self.printed["mean_settling_ratio"]
        margin = self.printed["half_rule_on_model_21_PM_deg"]
        return Table(
            "Formula (3) and the 50 plants",
            (Column("value", 2, tol.RATIO),),
            (
                Row("tau of 1/(s+1)^5 by (3), s", (Cell(self.printed["formula3_of_five_equal_lags_s"], found.L),)),
                Row(
                    "settling time on the estimate over that on the plant, mean of 50",
                    (Cell(ratio["printed"], mean(self.ratios), "a", ratio["recomputed"]),),
                ),
                Row("phase margin with the half rule in the place of plant 21, °", (Cell(margin, cause="b"),)),
            ),
            "The estimate by (2) to (5), with the gain of (5), stands in for the plant under the same Ziegler-Nichols "
            "PI.",
            {
                "a": "The dead times of 18 of the 50 plants are illegible and assumed, and the paper's own Ku and Pu "
                "come from test runs; here they are exact.",
                "b": "The plant has zeros in the left half-plane. Which lags they cancel is a choice that the paper "
                "does not state; our half rule refuses such plants.",
            },
        )

    def claims(self) -> tuple[Claim, ...]:
        return (
            Claim(
                "The estimate never makes the loop unstable where the plant is stable.",
                f"Unstable on {self.unstable} of {self.plants} plants.",
                self.unstable == 0,
            ),
            Claim(
                "The loop's IAE on the estimate is not worse than on the plant by more than 10 %.",
                f"Of the {self.untouched} plants whose Kp Stage 3 leaves as it is, worse by more are: "
                f"{', '.join(self.worse)}.",
                not self.worse,
                "On the others it is so.",
            ),
            Claim(
                "The overshoot is underestimated.",
                f"In the median it is lower by {-median(self.overshoots):.0f} points.",
                median(self.overshoots) < 0.0,
            ),
        )
