"""Linear process models with dead time. Frequency responses carry the dead time exactly, as exp(-j*w*L)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class FOPDT:
    """First order plus dead time, K*exp(-L*s)/(T*s + 1).

    K: PV units per MV unit, either sign.  T: time constant, s, positive.  L: dead time, s, not negative.
    """

    K: float
    T: float
    L: float

    def __post_init__(self) -> None:
        if not (np.isfinite([self.K, self.T, self.L]).all() and self.K != 0.0 and self.T > 0.0 and self.L >= 0.0):
            raise ValueError(f"not a model: K={self.K}, T={self.T} s, L={self.L} s")

    @property
    def num(self) -> tuple[float, ...]:
        return (self.K,)

    @property
    def den(self) -> tuple[float, ...]:
        return (self.T, 1.0)

    @property
    def static_gain(self) -> float:
        return self.K

    def frequency_response(self, w: Reals) -> Complexes:
        """At angular frequencies w, rad/s."""
        s = 1j * np.asarray(w, dtype=float)
        return np.asarray(self.K * np.exp(-self.L * s) / (self.T * s + 1.0))


@dataclass(frozen=True, slots=True)
class TransferFunction:
    """num(s)/den(s)*exp(-L*s), coefficients from the highest power down; bi-proper allowed, static gain finite.

    L: dead time, s.
    """

    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float = 0.0

    def __post_init__(self) -> None:
        for name in ("num", "den"):
            kept = np.trim_zeros(np.asarray(getattr(self, name), dtype=float), "f")
            object.__setattr__(self, name, tuple(float(c) for c in kept))
        if not self.num or len(self.den) < 2 or len(self.num) > len(self.den):
            raise ValueError("a transfer function needs a pole and a numerator no longer than its denominator")
        if not (np.isfinite([*self.num, *self.den, self.L]).all() and self.den[-1] and self.num[-1] and self.L >= 0.0):
            raise ValueError("coefficients must be finite, the static gain neither 0 nor infinite, the dead time >= 0")

    @property
    def static_gain(self) -> float:
        return self.num[-1] / self.den[-1]

    def frequency_response(self, w: Reals) -> Complexes:
        """At angular frequencies w, rad/s."""
        s = 1j * np.asarray(w, dtype=float)
        return np.asarray(np.polyval(self.num, s) / np.polyval(self.den, s) * np.exp(-self.L * s))


Model = FOPDT | TransferFunction


def time_constants(model: Model) -> Reals:
    """1/|p| of every pole p, s."""
    return np.asarray(1.0 / np.abs(np.roots(model.den)), dtype=float)
