"""The samples of a job as its plot reads them."""

from __future__ import annotations

import math

import pytest
from pydantic import ValidationError

from loopwright.service.cli.plots.shown import ShownSamples

COLUMNS = {"job": "x", "stage": ["relay"] * 2, "t_s": [0.0, 0.1], "sp": [50, 50], "mv": [40.0, 60.0], "mode": [3, 3]}


def test_a_sample_that_was_not_finite_is_nan() -> None:
    samples = ShownSamples.model_validate(COLUMNS | {"pv": [49.5, None]})
    assert samples.pv[0] == 49.5 and math.isnan(samples.pv[1])
    assert list(samples.columns()) == ["stage", "t_s", "sp", "pv", "mv", "mode"]


def test_a_column_that_is_missing_is_an_error() -> None:
    with pytest.raises(ValidationError, match="pv"):
        ShownSamples.model_validate(COLUMNS)
