"""How the certainty of Ms grows with the set-point changes of normal operation, as a picture.

    python -m benchmarks.certainty docs/observe.png

A loop of three equal lags with dead time under sluggish gains: an operator moves the set-point eight times, and the
load steps twice. After each change the operation is evaluated.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.command import parser_of
from benchmarks.operation import Kind, operation
from benchmarks.plants import Plant
from loopwright.service.cli.plots import style
from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.operation.observation import Observation, observe

CHANGES, SAMPLES, SEED = 8, 40, 6
ASKED = 1.6
LOWEST, HIGHEST = 1.44, 1.76
"""The axis of Ms."""


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
    figure = style.new_figure(9.0, 6.0)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 4))
    t = np.arange(len(history.sp)) * history.Ts / operated.Pu
    style.measured(top, np.asarray(t, dtype=np.float64), history.pv)
    top.step(t, history.sp, where="post", color=style.SETPOINT, linewidth=1.0, linestyle=":")
    for i, (text, colour) in enumerate((("band: PV", style.MEASURED), ("dotted: set-point", style.SETPOINT))):
        top.text(0.01, 0.97 - 0.09 * i, text, color=colour, fontsize=8.5, va="top", transform=top.transAxes)
    bottom.axhline(ASKED, color=style.SETPOINT, linewidth=0.8, linestyle=":")
    style.text_at(bottom, 0.0, ASKED, f"asked for: {ASKED:g}", style.SETPOINT)
    shown = [(n, each, each.evaluation) for n, each in enumerate(found, start=1) if each.evaluation is not None]
    for number, each, evaluation in shown:
        at = ((number + 1) * every - 2) * history.Ts / operated.Pu
        proposed = each.reason is None
        bottom.errorbar(
            at, evaluation.Ms, each.known_to, color=style.AFTER if proposed else style.BEFORE, marker="o", markersize=5,
            markerfacecolor=None if proposed else "white", capsize=4, linewidth=1.3,
        )  # fmt: skip
        true = margins(operated.model(), evaluation.best.gains).Ms
        bottom.plot(at, true, marker="x", color=style.SETPOINT, markersize=6, linestyle="", zorder=3)
        outcome = "proposed" if proposed else str(each.reason)
        used = f"{len(each.used)} used\n{outcome}"
        bottom.text(at, LOWEST, used, color="0.25", fontsize=8, ha="center", va="bottom")
    words = (
        ("dots: Ms on the model, with its uncertainty; open: not proposed", style.AFTER),
        ("crosses: Ms of these gains on the true plant", style.SETPOINT),
    )
    for i, (text, colour) in enumerate(words):
        bottom.text(0.01, 0.97 - 0.07 * i, text, color=colour, fontsize=8.5, va="top", transform=bottom.transAxes)
    top.set_xlim(0.0, float(t[-1]) + 6.0)
    bottom.set_ylim(LOWEST - 0.01, HIGHEST)
    style.plain(top, "PV, permitted steps")
    style.plain(bottom, "Ms", "time, ultimate periods")
    style.write(figure, path)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("path", type=Path)
    drawn(parser.parse_args().path)


if __name__ == "__main__":
    main()
