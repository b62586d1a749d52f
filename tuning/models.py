"""Linear process models with dead time. Frequency responses carry the dead time exactly, as exp(-j*w*L)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

ROUNDING = 1e-13
"""What is smaller than this part of the terms that it is the sum of is rounding."""
MANY_CHANNELS = "the transfer function has more than one input or output"


@dataclass(frozen=True, slots=True)
class FOPDT:
    """A plant of first order plus dead time, K*exp(-L*s)/(T*s + 1).

    K: the gain, PV units per MV unit, either sign.
    T: the time constant, s, positive.
    L: the dead time, s, not negative.
    """

    K: float
    T: float
    L: float

    def __post_init__(self) -> None:
        _check(self.K, positive={"T": self.T}, not_negative={"L": self.L})

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
        """The frequency response at the angular frequencies w, rad/s."""
        s = 1j * np.asarray(w, dtype=float)
        return np.asarray(self.K * np.exp(-self.L * s) / (self.T * s + 1.0))


@dataclass(frozen=True, slots=True, init=False)
class SOPDT:
    """A plant of second order plus dead time, K*exp(-L*s)/(T^2 s^2 + 2*zeta*T*s + 1), or with two real lags
    K*exp(-L*s)/((T1*s + 1)(T2*s + 1)): SOPDT(K, T, zeta, L) or SOPDT(K=..., T1=..., T2=..., L=...).

    K: the gain, PV units per MV unit, either sign.
    T: the reciprocal of the natural frequency, s, positive.
    zeta: the damping ratio, positive; the poles are complex for zeta < 1.
    L: the dead time, s, not negative.
    """

    K: float
    T: float
    zeta: float
    L: float

    def __init__(
        self,
        K: float,
        T: float | None = None,
        zeta: float | None = None,
        L: float | None = None,
        *,
        T1: float | None = None,
        T2: float | None = None,
    ) -> None:
        if T1 is not None and T2 is not None and T is None and zeta is None:
            _check(K, positive={"T1": T1, "T2": T2})
            T = math.sqrt(T1 * T2)
            zeta = (T1 + T2) / (2.0 * T)
        elif T1 is not None or T2 is not None:
            raise TypeError("SOPDT takes K, T, zeta, L or K, T1, T2, L")
        if T is None or zeta is None or L is None:
            raise TypeError("SOPDT takes K, T, zeta, L or K, T1, T2, L, all four of them")
        for name, value in (("K", K), ("T", T), ("zeta", zeta), ("L", L)):
            object.__setattr__(self, name, value)
        _check(self.K, positive={"T": self.T, "zeta": self.zeta}, not_negative={"L": self.L})

    def __repr__(self) -> str:
        """The model by its two lags where it has them."""
        named = {"T": self.T, "zeta": self.zeta} if math.isnan(self.T1) else {"T1": self.T1, "T2": self.T2}
        return f"SOPDT({', '.join(f'{n}={v:.10g}' for n, v in {'K': self.K, **named, 'L': self.L}.items())})"

    @property
    def T1(self) -> float:
        """The larger real time constant, s; NaN for complex poles."""
        return self._real(+1.0)

    @property
    def T2(self) -> float:
        """The smaller real time constant, s; NaN for complex poles."""
        return self._real(-1.0)

    def _real(self, sign: float) -> float:
        # two equal time constants give a zeta that is 1 but for rounding
        root = self.zeta * self.zeta - 1.0
        if root < -1e-12:
            return math.nan
        return self.T * (self.zeta + sign * math.sqrt(max(root, 0.0)))

    @property
    def num(self) -> tuple[float, ...]:
        return (self.K,)

    @property
    def den(self) -> tuple[float, ...]:
        return (self.T * self.T, 2.0 * self.zeta * self.T, 1.0)

    @property
    def static_gain(self) -> float:
        return self.K

    def frequency_response(self, w: Reals) -> Complexes:
        """The frequency response at the angular frequencies w, rad/s."""
        return _response(self.num, self.den, self.L, w)


@dataclass(frozen=True, slots=True)
class Integrating:
    """An integrating plant with dead time and possibly a lag, K*exp(-L*s)/(s*(T*s + 1)).

    K: the gain, PV units per MV unit and s, either sign.
    L: the dead time, s, not negative.
    T: the lag, s, not negative.
    """

    K: float
    L: float
    T: float = 0.0

    def __post_init__(self) -> None:
        _check(self.K, not_negative={"T": self.T, "L": self.L})

    @property
    def num(self) -> tuple[float, ...]:
        return (self.K,)

    @property
    def den(self) -> tuple[float, ...]:
        return (self.T, 1.0, 0.0) if self.T > 0.0 else (1.0, 0.0)

    @property
    def static_gain(self) -> float:
        """The static gain, which is infinite, with the sign of K."""
        return math.copysign(math.inf, self.K)

    def frequency_response(self, w: Reals) -> Complexes:
        """The frequency response at the angular frequencies w > 0, rad/s."""
        return _response(self.num, self.den, self.L, w)


@dataclass(frozen=True, slots=True)
class TransferFunction:
    """The transfer function num(s)/den(s)*exp(-L*s). It may be bi-proper and may have one pole at the origin.

    num, den: the coefficients, from the highest power down.
    L: the dead time, s.
    """

    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float = 0.0

    def __post_init__(self) -> None:
        for name in ("num", "den"):
            kept = np.trim_zeros(_coefficients(name, getattr(self, name)), "f")
            object.__setattr__(self, name, tuple(float(c) for c in kept))
        if not self.num or len(self.den) < 2 or len(self.num) > len(self.den):
            raise ValueError("a transfer function needs a pole and a numerator no longer than its denominator")
        if not (self.num[-1] and (self.den[-1] or self.den[-2])):
            raise ValueError("num must end with a coefficient other than 0, and den may have one pole at 0 at most")
        _check(1.0, not_negative={"L": self.L})

    @property
    def static_gain(self) -> float:
        """The static gain; for a pole at the origin it is infinite, with the sign of the slope."""
        if self.den[-1] == 0.0:
            return math.copysign(math.inf, self.num[-1] * self.den[-2])
        return self.num[-1] / self.den[-1]

    def frequency_response(self, w: Reals) -> Complexes:
        """The frequency response at the angular frequencies w, rad/s."""
        return _response(self.num, self.den, self.L, w)

    @staticmethod
    def from_control(system: LinearSystem, dead_time_s: float = 0.0) -> TransferFunction:
        """The model for a transfer function of control or scipy.signal; see `as_model`."""
        found = as_model(system, dead_time_s)
        return TransferFunction(found.num, found.den, found.L)

    def to_control(self, pade_order: int = 0) -> Any:
        """This model as control.TransferFunction, which has no dead time: a Pade approximation takes its place.

        pade_order: the order of the approximation; 0 is for models without dead time.
        Raises ValueError for a dead time without an order. Needs the library control.
        """
        import control

        if self.L and not pade_order:
            raise ValueError(f"control has no dead time: give pade_order for that of {self.L:g} s")
        system = control.TransferFunction(list(self.num), list(self.den))
        return system * control.TransferFunction(*control.pade(self.L, pade_order)) if self.L else system


Model = FOPDT | SOPDT | Integrating | TransferFunction


class LinearSystem(Protocol):
    """A transfer function of another library: control.TransferFunction, scipy.signal.TransferFunction.

    num, den: the coefficients from the highest power down, nested or not.
    dt: None or 0 for continuous time.
    """

    @property
    def num(self) -> Any: ...
    @property
    def den(self) -> Any: ...
    @property
    def dt(self) -> Any: ...


class WithModel(Protocol):
    """What has been found with a model, such as the result of `identify`; None where none was found."""

    @property
    def model(self) -> Model | None: ...


AnyModel = Model | LinearSystem | WithModel | tuple[ArrayLike, ArrayLike] | Mapping[str, Any]
"""What `as_model` takes."""


def as_model(system: AnyModel, dead_time_s: float = 0.0) -> Model:
    """The model of this library for a transfer function of another, which has no dead time of its own.

    system: the transfer function; a model of this library is returned as it is, and so is that of a result of
    `identify`. scipy's forms are accepted: numerator and denominator as a pair, zeros and poles, a state space; and a
    model by the names of its quantities, with or without their unit: {"K": 2, "T_s": 10, "L_s": 3}.
    dead_time_s: the dead time of a system of another library, s.
    Raises TypeError for what is no model. Raises ValueError for more than one input or output, discrete time, a dead
    time given twice, and coefficients that make no model.
    """
    if isinstance(system, Model) and not dead_time_s:
        return system
    if isinstance(system, Mapping):
        system = _by_names(system)
    elif isinstance(found := getattr(system, "model", None), Model):
        system = found
    elif found is None and hasattr(system, "model"):
        raise TypeError(f"this {type(system).__name__} has no model: {system!r}")
    if isinstance(system, Model):
        if dead_time_s:
            raise ValueError(
                f"the model has a dead time of its own ({system.L:g} s): dead_time_s={dead_time_s:g} is one too many"
            )
        return system
    if isinstance(system, tuple) and len(system) == 2:
        num, den = (_coefficients(name, each) for name, each in zip(("num", "den"), system, strict=True))
        return TransferFunction(tuple(num.tolist()), tuple(den.tolist()), dead_time_s)
    return _of_another_library(system, dead_time_s)


def _by_names(given: Mapping[str, Any]) -> Model:
    """The model whose quantities have these names; raises as `as_model`."""
    fraction = "num" in given or "den" in given
    named = {str(name).removesuffix("_s"): value for name, value in given.items()}
    if fraction and "L" in named:
        named["dead_time"] = named.pop("L")
    names, integrating = named.keys() - {"integrating"}, named.pop("integrating", False)
    if integrating is True and {"K", "L"} <= names <= {"K", "L", "T"}:
        return Integrating(**named)
    if integrating is False and names == {"K", "T", "L"}:
        return FOPDT(**named)
    if integrating is False and names in ({"K", "T", "zeta", "L"}, {"K", "T1", "T2", "L"}):
        return SOPDT(**named)
    if integrating is False and {"num", "den"} <= names <= {"num", "den", "dead_time"}:
        return TransferFunction(named["num"], named["den"], named.get("dead_time", 0.0))
    raise TypeError(
        f"{', '.join(map(str, given))}: no model has these quantities; give K, T, L; K, T1, T2, L; K, T, zeta, L; K, "
        "L, integrating, and T where it has a lag; or num, den, dead_time_s"
    )


def _check(K: object, positive: Mapping[str, Any] | None = None, not_negative: Mapping[str, Any] | None = None) -> None:
    """Raises TypeError for what is no number, ValueError for one that makes no model."""
    positive, not_negative = positive or {}, not_negative or {}
    for name, value in {"K": K, **positive, **not_negative}.items():
        if type(value) is not float and (isinstance(value, bool) or not isinstance(value, Real)):
            raise TypeError(f"{name} must be a number, not {value!r}")
    for name, value in (("K", K), *positive.items(), *not_negative.items()):
        unit = "" if name == "zeta" else " s"
        if not math.isfinite(value):
            raise ValueError(f"{name} must be a finite number, not {value}")
        if name == "K" and value == 0.0:
            raise ValueError("K must not be 0: PV would not answer MV")
        if name in positive and value <= 0.0:
            raise ValueError(f"{name} must be more than 0{unit}, not {value:g}")
        if name in not_negative and value < 0.0:
            raise ValueError(f"{name} must be 0{unit} or more, not {value:g}")


def _coefficients(name: str, given: object) -> Reals:
    """The coefficients as an array. Raises TypeError for what are no numbers, ValueError for one that is not finite."""
    try:
        found = np.atleast_1d(np.asarray(given))
    except ValueError:
        found = np.empty((0, 0))
    if found.ndim != 1 or found.dtype.kind not in "iuf":
        raise TypeError(f"{name} must be coefficients from the highest power of s down, such as (10, 1), not {given!r}")
    if not np.isfinite(found).all():
        raise ValueError(f"{name} must have finite coefficients, not {given!r}")
    return np.asarray(found, dtype=float)


def _of_another_library(given: Any, dead_time_s: float) -> TransferFunction:
    """The model for an object of control or scipy.signal; raises as `as_model`."""
    is_state_space = all(hasattr(given, name) for name in ("A", "B", "C", "D", "dt"))
    system = given.to_tf() if hasattr(given, "to_tf") and not is_state_space else given
    if not (is_state_space or all(hasattr(system, name) for name in ("num", "den", "dt"))):
        raise TypeError(
            f"{type(given).__name__} is no model: give FOPDT(K, T, L), SOPDT, Integrating, TransferFunction(num, den, "
            "L), or a transfer function of control or scipy.signal"
        )
    if system.dt:
        raise ValueError(f"the transfer function is in discrete time (dt={system.dt}): a model here is continuous")
    if is_state_space:
        num, den = _of_state_space(*(np.atleast_2d(np.asarray(getattr(given, name), dtype=float)) for name in "ABCD"))
    else:
        num, den = _only_channel(system.num), _only_channel(system.den)
    return TransferFunction(tuple(num.tolist()), tuple(den.tolist()), dead_time_s)


def _only_channel(nested: Any) -> Reals:
    """The coefficients of the system's only channel. Raises ValueError for more than one."""
    while len(nested) == 1 and hasattr(nested[0], "__len__"):
        nested = nested[0]
    if any(hasattr(each, "__len__") for each in nested):
        raise ValueError(MANY_CHANNELS)
    return np.asarray(nested, dtype=float)


def _of_state_space(A: Reals, B: Reals, C: Reals, D: Reals) -> tuple[Reals, Reals]:
    """Numerator and denominator of a state space, without the coefficients that are rounding: the first of the
    numerator, and the last of the denominator of a plant that integrates. Raises ValueError for more than one channel.
    """
    from scipy.signal import ss2tf

    if B.shape[1] != 1 or C.shape[0] != 1:
        raise ValueError(MANY_CHANNELS)
    # ss2tf subtracts B C from A: the gain is taken in a unit that makes their entries comparable
    largest_a, largest_b, largest_c = (float(np.max(np.abs(each))) for each in (A, B, C))
    unit = largest_b * largest_c / largest_a if largest_a and largest_b and largest_c else 1.0
    rows, den = ss2tf(A, B, C / unit, D / unit)
    num = unit * rows[0]
    # The first coefficients are 0 as long as the slopes C A^k B of the response to an impulse are. Each is judged by
    # the sizes of its own terms, which do not depend on the units of time, states and gain.
    slope, size = B, np.abs(B)
    for k in range(1, len(den) - 1 if D[0, 0] == 0.0 else 0):
        if abs(C @ slope)[0, 0] > ROUNDING * (np.abs(C) @ size)[0, 0]:
            break
        num[k] = 0.0
        slope, size = A @ slope, np.abs(A) @ size
    if _is_singular(A):
        den[-1] = 0.0
    return num, den


def _is_singular(A: Reals) -> bool:
    """Whether changes of its entries by the part ROUNDING of each may make the matrix singular."""
    try:
        nearest = np.linalg.eigvals(np.abs(np.linalg.inv(A)) @ np.abs(A))
    except np.linalg.LinAlgError:
        return True
    return bool(np.max(np.abs(nearest)) * ROUNDING > 1.0)


def time_constants(model: Model) -> Reals:
    """The time constants 1/|p| of all poles p that are not at the origin, s."""
    sizes = np.abs(np.roots(model.den))
    return np.asarray(1.0 / sizes[sizes > 0.0], dtype=float)


def integrators(model: Model) -> int:
    """The number of poles at the origin."""
    den = model.den
    return len(den) - len(np.trim_zeros(np.asarray(den), "b"))


def monic(model: Model) -> tuple[Reals, Reals]:
    """Returns numerator and denominator divided by the denominator's first coefficient, both of the same length."""
    den = np.asarray(model.den)
    num = np.concatenate((np.zeros(len(den) - len(model.num)), model.num))
    return num / den[0], den / den[0]


def sign(model: Model) -> float:
    """+1 when PV finally rises with MV, else -1."""
    return math.copysign(1.0, model.num[-1] * np.trim_zeros(np.asarray(model.den), "b")[-1])


def _response(num: tuple[float, ...], den: tuple[float, ...], L: float, w: Reals) -> Complexes:
    s = 1j * np.asarray(w, dtype=float)
    return np.asarray(np.polyval(num, s) / np.polyval(den, s) * np.exp(-L * s))
