"""Mabu Sarif, Ashok Kumar, Venu Gopal Rao, IMC-based PID: equations (39), (40), (42), Tables 1 and 2."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import trapezoid

from loopwright.tuning.analysis.stability import is_stable
from loopwright.tuning.analysis.step_response import step_figures, step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, Integrating, Reals
from loopwright.tuning.rules.registry import tune
from validation import tolerances as tol
from validation.checks import Cell, Claim, Column, Figure, Paper, Row, Table
from validation.loops import ideal_pid
from validation.references import References

HORIZON_S = 250.0
SETPOINT_AT_S = 1.0
DISTURBANCE = 0.25
DISTURBANCE_LAG_S = 30.0
STEP_S = 0.01

Indices = tuple[float, float, float]
NAMES = ("IAE", "ISE", "ITAE")


def check(references: References) -> Paper:
    more = references.more["imc"]
    return Paper(
        "IMC-based PID",
        "B. Mabu Sarif, D. V. Ashok Kumar, M. Venu Gopal Rao, Optimised control using PID controller tuned using "
        "internal model control, IJECE 10(3), 2020, DOI 10.11591/ijece.v10i3.pp2452-2462",
        "Case 1 is 100 exp(-s)/(100 s + 1) with lambda = 20, case 2 is 0.2 exp(-7.4 s)/s. The conditions of the tests "
        "are not stated; eight printed numbers fix those of case 1: set-point step at 1 s, disturbance 0.25 through "
        "1/(30 s + 1) onto the output at 0 s, integrals from 0 to 250 s. Where a printed mark of time is missing, "
        "seconds are meant.",
        (
            _equation_40(references),
            _equation_39(references),
            _table_1_pid(references),
            _table_1_imc(more["table1"]),
            _table_2(more["table2"]),
            _case_2_as_printed(references),
        ),
        _claims(references),
        (
            Figure("imc-case-1", "Case 1: set-point step and disturbance under IMC-PID, eq. (40), and ideal IMC."),
            Figure("imc-case-2", "Case 2 with the printed setting (42), and with rule (36), psi = 50, lambda = 7.4."),
        ),
    )


def case_1(references: References) -> tuple[FOPDT, float]:
    """The plant and lambda, s."""
    case = references.rules["imc"]["case1"]
    return FOPDT(case["K"], case["T"], case["L"]), case["lambda_s"]


def case_2(references: References) -> Integrating:
    case = references.rules["imc"]["case2"]
    return Integrating(case["K"], case["L"])


def _equation_40(references: References) -> Table:
    model, lambda_s = case_1(references)
    gains = tune("imc-pid", model, lambda_s=lambda_s).gains
    settings = references.rules["imc"]["case1"]["settings"]
    printed = next(row["printed"] for row in settings if row["rule"] == "IMC-PID-FOPDT")
    copied = references.more["imc"]["settings42"]
    ours = (gains.Kp, gains.Ti, gains.Td)
    return Table(
        "Equations (40) and (42), settings",
        (
            Column("Kp", 3, tol.EQUATION_40),
            Column("Ti", 1, tol.FROM_PRINTS, "s"),
            Column("Td", 1, tol.EQUATION_40_TD, "s"),
        ),
        (
            Row("(40), case 1", tuple(Cell(printed[k], x) for k, x in zip(("Kp", "Ti", "Td"), ours, strict=True))),
            Row("(42), case 2", tuple(Cell(copied[k], cause="a") for k in ("Kp", "Ti", "Td"))),
        ),
        causes={
            "a": "A copy of (40). Neither lambda nor psi is given for case 2. Rule (36) reaches Ti = 100.5 s with "
            "psi = 96.8 s only, and then Td is 3.56 s, not 0.5 s."
        },
    )


def _equation_39(references: References) -> Table:
    model, lambda_s = case_1(references)
    q = references.more["imc"]["Q39"]
    numerator = np.polymul([model.T, 1.0], [0.5 * model.L, 1.0])
    denominator = np.polymul([lambda_s, 1.0], [lambda_s, 1.0])
    exact = Column("value", 2, tol.CONSTANT)
    rows = [
        Row(f"{name}, {power}", (Cell(printed, float(ours)),))
        for name, polynomial, found in (
            ("numerator", q["numerator"], numerator),
            ("denominator", q["denominator"], denominator),
        )
        for power, printed, ours in zip(("s^2", "s", "1"), polynomial, found, strict=True)
    ]
    rows.append(Row("factor", (Cell(q["gain"], 1.0 / model.K, "a", q["exact_gain"]),)))
    return Table(
        "Equation (39), Q(s) of case 1",
        (exact,),
        tuple(rows),
        "Ours is (T s + 1)(theta s/2 + 1)/(K (lambda s + 1)^2). The square of the filter is the paper's slip too: (40) "
        "follows with the filter's first power, which is also what (24) and (25) need.",
        {"a": "The factor 1/K is missing."},
    )


def setpoint_error(model: FOPDT, gains: Gains) -> tuple[Reals, Reals]:
    """(t, e) of a unit step at 0, over the horizon."""
    response = step_response(model, gains, horizon=HORIZON_S, dt=STEP_S)
    keep = response.t <= HORIZON_S * (1.0 + 1e-12)
    return response.t[keep], 1.0 - response.y[keep]


def ideal_imc_error(model: FOPDT, lambda_s: float) -> tuple[Reals, Reals]:
    """The same of IMC with the exact model and a filter of first order: y/r = exp(-L s)/(lambda s + 1)."""
    t = np.linspace(0.0, HORIZON_S, round(HORIZON_S / STEP_S) + 1)
    return t, np.exp(-np.maximum(t - model.L, 0.0) / lambda_s)


def disturbed(t: Reals, error: Reals) -> Reals:
    """PV after the disturbance: its lag acts on the error of a set-point step, linear between the samples."""
    y = np.zeros(len(t))
    dt = np.diff(t)
    decay = np.exp(-dt / DISTURBANCE_LAG_S)
    # weights of the error at both ends of an interval
    share = np.divide((1.0 - decay) * DISTURBANCE_LAG_S, dt, out=np.ones_like(dt), where=dt > 0.0)
    late, early = 1.0 - share, share - decay
    for k in range(len(dt)):
        y[k + 1] = decay[k] * y[k] + DISTURBANCE * (early[k] * error[k] + late[k] * error[k + 1])
    return y


def indices(t: Reals, error: Reals, since: float = 0.0) -> Indices:
    """IAE, ISE, ITAE of an error that begins at `since` on the clock that t is counted on, up to the horizon."""
    keep = t + since <= HORIZON_S * (1.0 + 1e-12)
    clock, e = t[keep] + since, np.abs(error[keep])
    return float(trapezoid(e, clock)), float(trapezoid(e * e, clock)), float(trapezoid(clock * e, clock))


def _indices_of(t: Reals, error: Reals) -> dict[str, Indices]:
    return {"setpoint": indices(t, error, SETPOINT_AT_S), "disturbance": indices(t, disturbed(t, error))}


def _columns() -> tuple[Column, ...]:
    return (
        Column("IAE", 3, tol.PRINTED_IAE),
        Column("ISE", 3, tol.PRINTED_ISE, own=tol.SIMULATED_IAE),
        Column("ITAE", 1, tol.PRINTED_ITAE, own=tol.SIMULATED_ITAE),
    )


def _printed(rows: list[dict[str, Any]], controller: str, test: str) -> dict[str, Any]:
    return next(r for r in rows if r["controller"] == controller and r["test"] == test)


def _table_1_pid(references: References) -> Table:
    model, lambda_s = case_1(references)
    found = _indices_of(*setpoint_error(model, tune("imc-pid", model, lambda_s=lambda_s).gains))
    rows = []
    for test, odd in (("disturbance", "ISE"), ("setpoint", "ITAE")):
        row = _printed(references.more["imc"]["table1"], "IMC-PID", test)
        cells = (
            Cell(row["printed"][name], ours, "a" if name == odd else "", row["recomputed"][name])
            for name, ours in zip(NAMES, found[test], strict=True)
        )
        rows.append(Row(test.replace("setpoint", "set-point"), tuple(cells)))
    return Table(
        "Table 1, row IMC-PID",
        _columns(),
        tuple(rows),
        causes={
            "a": "Unknown. No derivative filter, no rounding of the settings, no Pade plant and no other rule of the "
            "paper gives it. 0.263 for 0.266 and 430.7 for 439.7 would fit, but that they were misread is a guess."
        },
    )


def _table_1_imc(table: list[dict[str, Any]]) -> Table:
    t = np.linspace(0.0, HORIZON_S, round(HORIZON_S / STEP_S) + 1)
    untouched = {
        "disturbance": indices(t, DISTURBANCE * (1.0 - np.exp(-t / DISTURBANCE_LAG_S))),
        "setpoint": indices(t, np.ones(len(t)), SETPOINT_AT_S),
    }
    rows = []
    for test in ("disturbance", "setpoint"):
        row = _printed(table, "IMC", test)
        cells = (
            Cell(row["printed"][name], ours, "a" if name == "ITAE" else "", row["recomputed"][name])
            for name, ours in zip(NAMES, untouched[test], strict=True)
        )
        rows.append(Row(test.replace("setpoint", "set-point"), tuple(cells)))
    return Table(
        "Table 1, row IMC, as what it is",
        _columns(),
        tuple(rows),
        "The row is no result of a control loop. Its numbers are the integrals of the disturbance that nobody "
        "controls, and of an error that stays at 1: the wrong signal was integrated, or the loop was not closed.",
        {"a": "Ten times too small in the print: an exponent was lost."},
    )


def _table_2(table: list[dict[str, Any]]) -> Table:
    rows = tuple(
        Row(
            f"{row['controller']}, {row['test'].replace('setpoint', 'set-point')}",
            tuple(Cell(row["printed"][name], cause="a") for name in NAMES),
        )
        for row in table
    )
    return Table(
        "Table 2, case 2",
        _columns(),
        rows,
        causes={
            "a": "lambda, psi, the disturbance and where it enters are not stated, and the printed setting (42) is "
            "that of case 1. Several settings fit the six numbers about equally well, so they identify none."
        },
    )


def _case_2_as_printed(references: References) -> Table:
    copied = references.more["imc"]["settings42"]
    other = next(r for r in references.loops["pid_loops"] if r["id"] == "C2 PID eq(42) as printed")
    found = step_figures(
        case_2(references), ideal_pid(copied["Kp"], copied["Ti"], copied["Td"]), horizon=other["horizon_s"]
    )
    s = other["setpoint"]
    return Table(
        "Case 2 under (42) as it is printed",
        (
            Column("overshoot", 1, tol.SIMULATED_OVERSHOOT, "%"),
            Column("ts 2 %", 0, tol.SIMULATED_SETTLING, "s"),
            Column("IAE", 1, tol.SIMULATED_IAE, "s"),
        ),
        (
            Row(
                "set-point",
                (
                    Cell(s["overshoot_pct"], found.overshoot_pct),
                    Cell(s["ts2"], found.settling_s),
                    Cell(s["IAE"], found.IAE),
                ),
            ),
        ),
        f"Unit set-point step, {other['horizon_s']:.0f} s. The printed Table 2 has an IAE of 24.",
        reference="independent simulation",
    )


def _claims(references: References) -> tuple[Claim, ...]:
    model, lambda_s = case_1(references)
    pid = tune("imc-pid", model, lambda_s=lambda_s).gains
    ours = _indices_of(*setpoint_error(model, pid))
    ideal = _indices_of(*ideal_imc_error(model, lambda_s))
    table = references.more["imc"]["table1"]
    printed = (
        _printed(table, "IMC", "setpoint")["printed"]["IAE"] / _printed(table, "IMC-PID", "setpoint")["printed"]["IAE"]
    )
    ratio = ideal["setpoint"][0] / ours["setpoint"][0]
    disturbance_ratio = ideal["disturbance"][0] / ours["disturbance"][0]
    unit = FOPDT(1.0, 100.0, 1.0)
    quarter = tune("imc-pid", unit, lambda_s=0.25, extrapolate=True).gains
    eighty = tune("imc-pid", unit, lambda_s=0.8).gains
    at_quarter, at_eighty = step_figures(unit, quarter), step_figures(unit, eighty)
    return (
        Claim(
            f"Case 1: IMC-PID is better than IMC by a factor (IAE of the set-point step: {printed:.0f}).",
            f"An IMC with the same first-order filter and the exact model has {ratio:.2f} times its IAE, and "
            f"{disturbance_ratio:.2f} times after the disturbance.",
            ratio > 2.0,
            "The printed IMC row is no closed loop, so the comparison has no support.",
        ),
        Claim(
            "lambda above 0.8 theta is a safe choice.",
            f"At 0.8 theta the set-point step overshoots by {at_eighty.overshoot_pct:.0f} % and is stable.",
            is_stable(unit, eighty) and at_eighty.overshoot_pct < 20.0,
        ),
        Claim(
            "lambda above 0.25 theta is enough.",
            f"For (26) to (28) it is not: at 0.25 theta the overshoot is {at_quarter.overshoot_pct:.0f} %.",
            at_quarter.overshoot_pct < 20.0,
            "The guideline belongs to (11) with its own lag, (15), not to the rule that the paper uses.",
        ),
    )
