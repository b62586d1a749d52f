"""The five-stage paper's reactor, linearised at its operating point: its numbers and its loops."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import signal

from loopwright.plantsim.reactor import INLET, MV_NOMINAL, STEADY_STATE, derivative
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.analysis.step_response import step_figures
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.overshoot import fopdt_from_overshoot
from loopwright.tuning.models import FOPDT, Reals, TransferFunction
from loopwright.tuning.rules.robust_pi import optimise
from validation import tolerances as tol
from validation.checks import Cell, Claim, Column, Row, Table


def linear_reactor(lag_s: float = 4.0, delay_s: float = 10.0) -> TransferFunction:
    """From MV, percent, to the concentration of C, mol/m3, with the actuator's lag and the sensor's delay, s."""
    nominal = np.array(STEADY_STATE)

    def slope(state: Reals, opening: float) -> Reals:
        CA, CB, CC, h, T = (float(x) for x in state)
        return np.array(derivative((CA, CB, CC, h, T), opening, INLET))

    A = np.zeros((5, 5))
    for i, step in enumerate(1e-5 * np.abs(nominal)):
        moved = step * np.eye(5)[i]
        A[:, i] = (slope(nominal + moved, MV_NOMINAL) - slope(nominal - moved, MV_NOMINAL)) / (2.0 * step)
    B = (slope(nominal, MV_NOMINAL + 1e-3) - slope(nominal, MV_NOMINAL - 1e-3)) / 2e-3
    num, den = signal.ss2tf(A, B[:, None], np.eye(5)[2:3], np.zeros((1, 1)))
    # what differences leave of the coefficients that are zero: the relative degree is one
    kept = np.where(np.abs(num[0]) > 1e-9 * np.max(np.abs(num[0])), num[0], 0.0)
    return TransferFunction(tuple(kept), tuple(np.polymul(den, [lag_s, 1.0])), delay_s)


def tables(reactor: dict[str, Any]) -> tuple[Table, ...]:
    return _numbers(reactor), _overshoot(reactor)


def controllers(reactor: dict[str, Any]) -> dict[str, Gains]:
    """The four of the paper, by name."""
    p = reactor["printed"]
    zn = Gains(p["ZN"]["Kp"], p["ZN"]["Ti"])
    return {
        "ZN": zn,
        "retuned": Gains(p["retuned"]["factor"] * zn.Kp, zn.Ti),
        "optimised": Gains(p["opt"]["Kp"], p["opt"]["Ti"]),
        "pidtune": Gains(p["pidtune"]["Kp"], p["pidtune"]["Ti"]),
    }


def _numbers(reactor: dict[str, Any]) -> Table:
    p, settled, other = reactor["printed"], reactor["settled"]["estimated"], reactor["recomputed"]
    Ku, Pu = ultimate_point(linear_reactor())
    Ku3, Pu3 = ultimate_point(linear_reactor(lag_s=3.0))
    estimate = fopdt_from_overshoot(
        p["retuned"]["factor"] * p["Ku"] / 2.2, p["ZN"]["Ti"], p["retuned"]["overshoot_pct"]
    )
    best = optimise(FOPDT(settled["k"], settled["T"], settled["tau"])).gains
    lag3 = other["lag3_delay10"]
    return Table(
        "Reactor",
        (
            Column("Ku or k or Kp", 3, tol.FORMULA, own=tol.ULTIMATE_GAIN),
            Column("Pu or T or Ti", 2, tol.FORMULA, "s", tol.ULTIMATE_PERIOD),
        ),
        (
            Row("ultimate point, actuator lag 4 s", (Cell(p["Ku"], Ku), Cell(p["Pu"], Pu))),
            Row(
                "the same with the printed lag, 3 s",
                (Cell(p["Ku"], Ku3, "a", lag3["Ku"]), Cell(p["Pu"], Pu3, "a", lag3["Pu"])),
            ),
            Row("Ziegler-Nichols PI", (Cell(p["ZN"]["Kp"], p["Ku"] / 2.2), Cell(p["ZN"]["Ti"], p["Pu"] / 1.2))),
            Row(
                "estimate by (2), (4), (5)",
                (Cell(p["estimated"]["k"], estimate.k5), Cell(p["estimated"]["T"], estimate.T, "b", settled["T"])),
            ),
            Row("optimised PI of the estimate", (Cell(p["opt"]["Kp"], best.Kp), Cell(p["opt"]["Ti"], best.Ti))),
        ),
        "Linearised at 50 %. The sensor's delay is illegible; 10 s, with an actuator lag of 4 s, gives the ultimate "
        "point.",
        {
            "a": "With the printed actuator lag no delay gives both Ku and Pu; 10 s is shown. A misprint, or a lag in "
            "the paper's model that it does not list.",
            "b": "One wrong digit: (2) and (4), the margin of pidtune's controller and the optimum all want 16.89 s.",
        },
    )


def _overshoot(reactor: dict[str, Any]) -> Table:
    found = step_figures(linear_reactor(), controllers(reactor)["retuned"])
    return Table(
        "Reactor, overshoot with one and a half times the Ziegler-Nichols gain",
        (Column("OV", 1, tol.OVERSHOOT, "%"),),
        (Row("set-point step", (Cell(reactor["printed"]["retuned"]["overshoot_pct"], found.overshoot_pct),)),),
        "With the printed gain, 1.5 times 0.7. It is sensitive: 1.5 times the unrounded 0.695 gives 9.2 %.",
    )


def claims(reactor: dict[str, Any]) -> tuple[Claim, ...]:
    rest = max(abs(rate) for rate in derivative(STEADY_STATE, MV_NOMINAL, INLET))
    model = linear_reactor()
    IAE = {name: step_figures(model, gains).IAE for name, gains in controllers(reactor).items()}
    return (
        Claim(
            "The initial state of the reactor is at rest.",
            "With the heat of reaction and reference temperature that the balance wants, all rates are below 1e-10.",
            rest < 1e-10,
        ),
        Claim(
            "On the reactor the optimised PI is best, pidtune's close to it, the Ziegler-Nichols PI last.",
            f"IAE of a set-point step: {IAE['optimised']:.1f}, {IAE['pidtune']:.1f}, {IAE['ZN']:.1f} mol/m3 s.",
            IAE["optimised"] < IAE["pidtune"] < 1.1 * IAE["optimised"] < IAE["ZN"],
        ),
    )
