"""The ISA controller's feedback path, written out for tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.gains import Gains


def response(gains: Gains, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """At the complex frequencies s; Ti = 0 is no integral."""
    integral = 1.0 / (gains.Ti * s) if gains.Ti > 0.0 else 0.0
    return np.asarray(gains.Kp * (1.0 + integral + gains.Td * s / (1.0 + gains.Tf * s)))
