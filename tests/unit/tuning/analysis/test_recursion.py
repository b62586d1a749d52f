"""The compiled filter of scipy, loaded without scipy.signal."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.signal import lfilter

from loopwright.tuning.analysis.recursion import compiled_filter, public_filter, recursive


@pytest.mark.parametrize("recursion", [[1.0, -0.9], [2.0, -3.4, 1.44], [1.0, *np.zeros(200), 0.5]])
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_it_is_the_filter_of_scipy_bit_for_bit(recursion: list[float], count: int) -> None:
    u = np.random.default_rng(1).normal(size=count)
    expected = lfilter(np.ones(1), np.array(recursion), u)
    compiled = compiled_filter()
    assert compiled is not None, "this scipy keeps its filter elsewhere: recursions run, and import scipy.signal"
    for found in (recursive, lambda a, u: compiled(np.ones(1), a, u), lambda a, u: public_filter()(np.ones(1), a, u)):
        assert np.array_equal(found(np.array(recursion), u), expected)


def test_neither_scipy_signal_nor_scipy_stats_is_imported() -> None:
    code = (
        "import sys, numpy as np; from loopwright.tuning.analysis.recursion import recursive\n"
        "assert recursive(np.array([1.0, -0.5]), np.ones(3)).tolist() == [1.0, 1.5, 1.75]\n"
        "assert not {'scipy.signal', 'scipy.stats'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
