"""The picture of a job of fast or setpoint: the responses before and after are seen whole."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from loopwright.service.cli.plots.fast_job import before_after
from loopwright.service.cli.plots.shown import Shown
from loopwright.service.inputs.model_json import parse_model
from loopwright.service.results import GainsView
from loopwright.tuning.analysis.assessment import assess
from loopwright.tuning.gains import Gains

PLANT = parse_model({"num": [0.03, 0.02], "den": [3, 4, 1], "dead_time_s": 1.0})


def drawn_axes(old: Gains, new: Gains, step: float | None = 0.1) -> list[Axes]:
    """The axes of the responses before and after."""
    job: Any = SimpleNamespace(
        loop="TIC-1",
        model=SimpleNamespace(process_model=lambda: PLANT),
        previous_gains=GainsView.of(old),
        new_gains=GainsView.of(new),
        verification=None if step is None else SimpleNamespace(step=step),
        sample_time_s=None,
    )
    figure = Figure()
    before_after(figure, cast(Shown, job), "degC")
    return figure.axes


@pytest.mark.parametrize("step", [0.1, -0.1, None])
def test_the_step_is_shown_whole_whichever_way_the_loop_was_stepped(step: float | None) -> None:
    gains = Gains(60.0, 2.0)
    for axes in drawn_axes(gains, gains, step):
        low, high = axes.get_ylim()
        drawn = [float(value) for line in axes.get_lines() for value in np.asarray(line.get_ydata())]
        assert low <= min(drawn) and max(drawn) <= high


def test_the_slower_loop_is_drawn_until_it_has_settled_or_the_faster_one_is_lost() -> None:
    new, swinging, slow = Gains(30.0, 2.0), Gains(100.0, 1.0), Gains(3.0, 8.0)
    settled = {each: assess(PLANT, each).setpoint for each in (new, swinging, slow)}
    times = {each: figures.settling_s for each, figures in settled.items() if figures and figures.settling_s}
    assert 2.5 * times[new] < times[swinging] < 6.0 * times[new] < times[slow]
    for old, shown in ((swinging, times[swinging]), (slow, 6.0 * times[new]), (new, 2.5 * times[new])):
        assert drawn_axes(old, new)[0].get_xlim()[1] == pytest.approx(shown)
