"""The picture of a job of fast or setpoint: the responses before and after are seen whole."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from matplotlib.figure import Figure

from loopwright.service.cli.plots.fast_job import before_after
from loopwright.service.cli.plots.shown import Shown
from loopwright.service.inputs.model_json import parse_model
from loopwright.service.results import GainsView
from loopwright.tuning.gains import Gains


@pytest.mark.parametrize("step", [0.1, -0.1, None])
def test_the_step_is_shown_whole_whichever_way_the_loop_was_stepped(step: float | None) -> None:
    gains = GainsView.of(Gains(60.0, 2.0))
    model = SimpleNamespace(
        process_model=lambda: parse_model({"num": [0.03, 0.02], "den": [3, 4, 1], "dead_time_s": 1.0})
    )
    verification = None if step is None else SimpleNamespace(step=step)
    job: Any = SimpleNamespace(loop="TIC-1", model=model, old_gains=gains, new_gains=gains, verification=verification)
    figure = Figure()
    before_after(figure, cast(Shown, job), "degC")
    for axes in figure.axes:
        low, high = axes.get_ylim()
        drawn = [float(value) for line in axes.get_lines() for value in np.asarray(line.get_ydata())]
        assert low <= min(drawn) and max(drawn) <= high
