"""How the certainty of Ms grows with the set-point changes of normal operation, as a picture.

    python -m benchmarks.certainty docs/observe.png

A loop of three equal lags with dead time under sluggish gains: an operator moves the set-point eight times, and the
load steps twice. After each change the operation is evaluated.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.command import parser_of
from benchmarks.operation import Kind, operation
from benchmarks.plants import Plant
from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.fast.design import DesignSpec
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.operation.observation import Observation, observe

CHANGES, SAMPLES, SEED = 8, 40, 6
ASKED = 1.6


def plant() -> Plant:
    """The plant that is operated."""
    model = TransferFunction((1.0,), (1.0, 3.0, 3.0, 1.0), 1.0)
    return Plant("three lags", model.num, model.den, model.L, *ultimate_point(model), SAMPLES)


def evaluations(history: Stretch, every: int) -> list[Observation]:
    """The evaluation after each change."""
    found = []
    for changes in range(1, CHANGES + 1):
        until = slice((changes + 1) * every - 2)
        part = replace(history, mv=history.mv[until], pv=history.pv[until], sp=history.sp[until])
        found.append(observe([part], True, DesignSpec(ASKED)))
    return found


def drawn(path: Path) -> None:
    operated = plant()
    gains = Gains(0.18 * operated.Ku, 0.5 * operated.Pu)
    random = np.random.default_rng(SEED)
    history = operation(operated, gains, Kind(noise=0.02, loads=True, most_loads=2), random, CHANGES)
    every = len(history.sp) // (CHANGES + 1)
    found = evaluations(history, every)
    figure = Figure(figsize=(8.0, 5.2), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    t = np.arange(len(history.sp)) * history.Ts / operated.Pu
    top.plot(t, history.pv, lw=0.7, label="PV")
    top.plot(t, history.sp, lw=1.0, color="black", label="SP")
    top.set_ylabel("permitted steps")
    top.legend(loc="lower right", ncols=2, fontsize=8)
    bottom.axhline(ASKED, color="black", lw=0.8, label="Ms asked for")
    for number, each in enumerate(found, start=1):
        if each.evaluation is None:
            continue
        at = ((number + 1) * every - 2) * history.Ts / operated.Pu
        spread = max(each.evaluation.uncertainty, each.evaluation.ambiguity)
        colour = "tab:green" if each.reason is None else "tab:red"
        bottom.errorbar(at, each.evaluation.Ms, spread, color=colour, marker="o", ms=4, capsize=4)
        true = margins(operated.model(), each.evaluation.best.gains).Ms
        bottom.plot(at, true, marker="x", color="black", ls="")
        outcome = "proposed" if each.reason is None else each.reason.value
        bottom.annotate(f"{len(each.used)} used\n{outcome}", (at, 1.31), ha="center", va="bottom", fontsize=7)
    bottom.plot([], [], marker="o", color="tab:green", ls="", label="Ms on the model, with uncertainty")
    bottom.plot([], [], marker="x", color="black", ls="", label="Ms of these gains on the true plant")
    bottom.set(ylim=(1.3, 2.1), xlabel="time in ultimate periods", ylabel="Ms")
    bottom.legend(loc="upper right", fontsize=8)
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("path", type=Path)
    drawn(parser.parse_args().path)


if __name__ == "__main__":
    main()
