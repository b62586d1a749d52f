"""A linear recursion, run by scipy's compiled filter.

The filter is loaded from its file, not by `from scipy.signal import lfilter`: scipy.signal imports scipy.stats and half
of scipy besides, 0.6 s of processor time, which every command, service and computation that runs a recursion would pay.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import scipy

from loopwright.tuning.models import Reals

Filter = Callable[[Reals, Reals, Reals], Reals]


def compiled_filter() -> Filter | None:
    """Returns the function that scipy.signal.lfilter calls; None where this version of scipy keeps it elsewhere."""
    for suffix in EXTENSION_SUFFIXES:
        file = Path(scipy.__file__).with_name("signal") / f"_sigtools{suffix}"
        if file.exists() and (spec := spec_from_file_location("scipy.signal._sigtools", file)) and spec.loader:
            module = module_from_spec(spec)
            spec.loader.exec_module(module)
            found = getattr(module, "_linear_filter", None)
            return None if found is None else partial(_along_the_last_axis, found)
    return None


def _along_the_last_axis(found: Callable[[Reals, Reals, Reals, int], Reals], b: Reals, a: Reals, x: Reals) -> Reals:
    return np.asarray(found(b, a, x, -1))


def public_filter() -> Filter:
    """Returns scipy.signal.lfilter."""
    from scipy.signal import lfilter

    return lambda b, a, x: np.asarray(lfilter(b, a, x))


_ONE = np.ones(1)
_filter = compiled_filter() or public_filter()  # as this module is imported, and not in the middle of a test


def recursive(recursion: Reals, u: Reals) -> Reals:
    """The solution y of recursion[0] y[n] + recursion[1] y[n-1] + ... = u[n], at rest before n = 0; u, y: shape
    (..., N)."""
    return _filter(_ONE, recursion, u)
