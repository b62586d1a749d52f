"""Romasevych, Loveikin, Usenko, PI by multi-epoch particle swarm: Table 4, its settings, its indices, its optima."""

from __future__ import annotations

from functools import cache

import numpy as np

from loopwright.tuning.gains import Gains, to_reciprocal
from loopwright.tuning.models import Model, TransferFunction
from loopwright.tuning.reasons import Refused
from loopwright.tuning.rules.complex_criterion import ComplexCriterion, Weighting
from loopwright.tuning.rules.me_pso import me_pso
from loopwright.tuning.rules.registry import tune
from validation import tolerances as tol
from validation.checks import Cell, Claim, Column, Figure, Paper, Row, Table
from validation.euler import Rational, euler_indices
from validation.loops import moments, plant
from validation.references import References

HORIZON_S = {"G1": 60.0, "G2": 60.0, "G3": 60.0, "G4": 20.0, "G5": 80.0}
SMOOTH = (Weighting.ERROR, Weighting.CONTROL)
"""Weightings whose least is not on an edge of the criterion."""
OWN_KEYS = ("MIE", "MIC", "overshoot_pct", "ts")
PLANTS = {
    "G1": "1/(s + 1)^2",
    "G2": "1/(s + 1)^3",
    "G3": "(1 - 0.1 s)/(s + 1)^3",
    "G4": "1/((s + 1)(0.1 s + 1)(0.01 s + 1)(0.001 s + 1))",
    "G5": "exp(-s)/(0.5 s + 1)^2",
}
CAUSES = {
    "a": "The paper's integration: its overshoots are too high by what grows with the gain, as with Euler's method at "
    "a fixed step. See the table below.",
    "b": "The zero of G3 was simulated without the jump of MV at t = 0. See the table below.",
    "c": "Not explained: half an oscillation off, with the zero's jump or without.",
    "d": "ts is one dead time short in the three ME-PSO rows of G5, not in the others; MIE and MIC are means up to ts.",
    "e": "The same, and the exact answer dips to 0.9496 after that: it leaves the 5 % band once more.",
}
NOT_MET: dict[tuple[str, str], tuple[str, str, str, str]] = {
    ("G1", "ME-PSO-Error"): ("", "a", "a", ""),
    ("G2", "Cohen-Coon"): ("", "", "a", "a"),
    ("G2", "Tyreus-Luyben"): ("", "", "a", ""),
    ("G3", "Cohen-Coon"): ("", "", "b", ""),
    ("G3", "Skogestad"): ("b", "b", "", "b"),
    ("G3", "Tyreus-Luyben"): ("", "", "", "b"),
    ("G3", "ME-PSO-Error"): ("c", "", "c", "c"),
    ("G3", "ME-PSO-Duration"): ("b", "b", "b", "b"),
    ("G4", "Cohen-Coon"): ("", "", "a", ""),
    ("G4", "Tyreus-Luyben"): ("", "a", "a", ""),
    ("G4", "ME-PSO-Error"): ("", "a", "a", ""),
    ("G5", "ME-PSO-Error"): ("", "", "", "d"),
    ("G5", "ME-PSO-Control"): ("d", "d", "", "d"),
    ("G5", "ME-PSO-Duration"): ("e", "", "", "e"),
}
EULER_STEP_S = {"G1": 0.01, "G2": 0.02, "G3": 0.01, "G4": 0.001}


def check(references: References) -> Paper:
    return Paper(
        "PI by multi-epoch particle swarm (ME-PSO)",
        "Y. Romasevych, V. Loveikin, S. Usenko, PI-controller tuning optimization via PSO-based technique",
        "The paper's Ti is the reciprocal of the integral gain, 1/Ki. What it leaves open is read so: settling is the "
        "last exit from a band of 5 %, the terminal term is taken at the end of 60 s (G4 20 s, G5 80 s).",
        (
            _settings(references),
            *(_indices(references, name) for name in PLANTS),
            _integrated_as_they_did(references),
            _optima(references),
        ),
        _claims(references),
        tuple(Figure(f"me-pso-{name.lower()}", f"{name} = {PLANTS[name]}: printed settings.") for name in PLANTS),
    )


def by_rule(references: References, name: str, rule: str) -> Gains:
    """The rule as that paper used it: on the model by moments, the half rule or the ultimate point of its plant."""
    fitted = moments(references, name)
    whole = plant(references.search["paper_b"]["plants"][name])
    cases: dict[str, tuple[Model, str, dict[str, object]]] = {
        "Ziegler-Nichols": (fitted, "zn-step", {"extrapolate": True}),
        "Kappa-Tau": (fitted, "kappa-tau", {}),
        "AMIGO": (fitted, "amigo", {}),
        "Chien-Hrones-Reswick": (fitted, "chr", {"aim": "load", "extrapolate": True}),
        "Cohen-Coon": (fitted, "cohen-coon", {"variant": "tau", "extrapolate": True}),
        "Lambda": (fitted, "lambda", {}),
        "Skogestad": (whole, "simc", {}),
        "Tyreus-Luyben": (whole, "tyreus-luyben", {"variant": "0.45"}),
    }
    model, method, options = cases[rule]
    return tune(method, model, **options).gains


def _settings(references: References) -> Table:
    rows, by_formula = [], references.more["me_pso"]["lambda_rule"]
    for name, settings in references.rules["me_pso"]["table4"].items():
        for rule, printed in settings.items():
            if printed is None:
                continue
            found = to_reciprocal(by_rule(references, name, rule))
            Kp, Ti = Cell(printed[0], found.Kp), Cell(printed[1], found.Ti)
            if (name, rule) == ("G4", "Lambda"):
                Kp = Cell(printed[0], found.Kp, "a", by_formula[name]["Kp"])
                Ti = Cell(printed[1], found.Ti, "a", by_formula[name]["Ti"])
            elif (name, rule) == ("G5", "Lambda"):
                Ti = Cell(printed[1], found.Ti, "b", by_formula[name]["Ti"])
            rows.append(Row(f"{name} {rule}", (Kp, Ti)))
    return Table(
        "Table 4, settings of the classical rules",
        (Column("Kp", 3, tol.CLASSICAL), Column("Ti", 3, tol.CLASSICAL)),
        tuple(rows),
        "On FOPDT models by moments; Skogestad by the half rule, Tyreus-Luyben on the ultimate point. Cohen-Coon has a "
        "gain with 0.92 where the original has 0.092.",
        {
            "a": "No variant of the rule was found that gives these two numbers.",
            "b": "The print has an integral time of 3 L here, and of T on the other plants.",
        },
    )


def _index_columns() -> tuple[Column, ...]:
    return (
        Column("MIE", 2, tol.MIE, own=tol.OWN_MIE),
        Column("MIC", 2, tol.MIC, own=tol.OWN_MIC),
        Column("overshoot", 1, tol.TABLE_4_OVERSHOOT, "%", tol.OWN_OVERSHOOT),
        Column("ts", 1, tol.TABLE_4_SETTLING, "s", tol.OWN_SETTLING),
    )


def printed_rows(references: References, name: str) -> dict[str, list[float]]:
    """Kp, Ti (the paper's), MIE, MIC, overshoot in percent, ts in s, by method."""
    rows: dict[str, list[float] | None] = references.search["paper_b"]["printed"]["table4"][name]
    return {method: row for method, row in rows.items() if row}


def exact_indices(references: References, name: str) -> dict[str, tuple[float, ...]]:
    """At the printed settings, by method, in the order of the print."""
    rows = printed_rows(references, name)
    settings = np.array([row[:2] for row in rows.values()])
    model = plant(references.search["paper_b"]["plants"][name])
    found = ComplexCriterion(model, Weighting.ERROR, HORIZON_S[name]).indices(settings[:, 0], settings[:, 1])
    columns = np.array([found.MIE, found.MIC, 100.0 * found.overshoot, found.settling]).T
    return {method: tuple(float(x) for x in row) for method, row in zip(rows, columns, strict=True)}


def _indices(references: References, name: str) -> Table:
    ours, rows, used = exact_indices(references, name), [], set()
    for method, printed in printed_rows(references, name).items():
        causes = NOT_MET.get((name, method), ("", "", "", ""))
        used |= set(causes)
        other = references.search["paper_b"]["recomputed"]["table4_at_printed_settings"][name][method]
        cells = (
            Cell(p, o, cause, other[key])
            for p, o, cause, key in zip(printed[2:], ours[method], causes, OWN_KEYS, strict=True)
        )
        rows.append(Row(method, tuple(cells)))
    return Table(
        f"Table 4, indices on {name} = {PLANTS[name]}",
        _index_columns(),
        tuple(rows),
        "At the printed settings.",
        {key: text for key, text in CAUSES.items() if key in used},
    )


def _integrated_as_they_did(references: References) -> Table:
    rows = []
    for (name, method), causes in NOT_MET.items():
        if not set(causes) & {"a", "b"}:
            continue
        printed = printed_rows(references, name)[method]
        entry = references.search["paper_b"]["plants"][name]
        found = euler_indices(
            Rational(entry["num"], entry["den"]), printed[0], printed[1], EULER_STEP_S[name], HORIZON_S[name]
        )
        rows.append(Row(f"{name} {method}", tuple(Cell(p, o) for p, o in zip(printed[2:], found, strict=True))))
    return Table(
        "Table 4, rows with cause a or b, integrated as the paper must have done",
        (
            Column("MIE", 2, tol.MIE),
            Column("MIC", 2, tol.MIC),
            Column("overshoot", 1, tol.TABLE_4_OVERSHOOT, "%"),
            Column("ts", 1, tol.TABLE_4_SETTLING, "s"),
        ),
        tuple(rows),
        "Euler's method at a step of "
        + ", ".join(f"{step:g} s ({name})" for name, step in EULER_STEP_S.items())
        + ", chosen to fit; the zero of G3 by a backward difference that leaves out the jump of MV at t = 0.",
    )


def _search(references: References, name: str, weighting: Weighting, optimiser: str) -> float:
    """The least criterion that an optimiser finds on the paper's problem."""
    paper = references.search["paper_b"]
    domain = paper["printed"]["domains"][name]
    model = plant(paper["plants"][name])
    return _min(model, weighting, optimiser, HORIZON_S[name], float(domain["Kp"][1]), float(domain["Ti"][1]))


@cache
def _min(
    model: TransferFunction, weighting: Weighting, optimiser: str, horizon_s: float, Kp_max: float, Ti_max: float
) -> float:
    found = me_pso(
        model,
        weighting=weighting,
        optimiser=optimiser,
        Ms_max=0.0,
        horizon_s=horizon_s,
        Kp_max=Kp_max,
        Ki_min=1.0 / Ti_max,
    )
    return found.chosen["criterion"]


def _at_printed(references: References, name: str, weighting: Weighting) -> float:
    """The criterion at the setting that the paper prints as its optimum."""
    row = printed_rows(references, name)[f"ME-PSO-{weighting.capitalize()}"]
    criterion = ComplexCriterion(plant(references.search["paper_b"]["plants"][name]), weighting, HORIZON_S[name])
    return float(criterion(np.array(row[:1]), np.array(row[1:2]))[0])


def _best_known(references: References, name: str, weighting: Weighting) -> dict[str, float]:
    """By an independent calculation."""
    found: dict[str, float] = references.search["paper_b"]["recomputed"]["best_found"][name][weighting[0].upper()]
    return found


def _optima(references: References) -> Table:
    rows = []
    for name in PLANTS:
        for weighting in Weighting:
            best = _best_known(references, name, weighting)
            at_printed = Cell(best["criterion_at_printed_ME_PSO"], _at_printed(references, name, weighting))
            minimum = Cell(best["criterion"], _search(references, name, weighting, "nelder-mead"))
            rows.append(Row(f"{name} {weighting}", (at_printed, minimum)))
    return Table(
        "The criterion at the printed ME-PSO settings and at its least",
        (Column("at the printed setting", 0, tol.CRITERION), Column("least", 0, tol.BEST_FOUND)),
        tuple(rows),
        "The paper prints no value of its criterion. Ours is the least that Nelder-Mead finds from many starts in the "
        "paper's domain.",
        reference="independent calculation",
    )


def _claims(references: References) -> tuple[Claim, ...]:
    better = close = beaten = 0
    for name in PLANTS:
        for weighting in Weighting:
            found, at_printed = _search(references, name, weighting, "me-pso"), _at_printed(references, name, weighting)
            better += found < at_printed
            close += found < 1.01 * _best_known(references, name, weighting)["criterion"] and weighting in SMOOTH
            beaten += _search(references, name, weighting, "nelder-mead") < (1.0 - 1e-4) * at_printed
    figures = {name: exact_indices(references, name) for name in PLANTS}
    overshoots = {name: rows["ME-PSO-Duration"][2] for name, rows in figures.items()}
    fastest = {name: min(rows, key=lambda m: rows[m][3]) for name, rows in figures.items()}
    theirs, slowest = figures["G5"]["ME-PSO-Duration"][3], [figures["G5"][m][3] for m in _classical(references, "G5")]
    return (
        Claim(
            "The printed ME-PSO settings are the optima of its criterion.",
            f"A better setting was found in {beaten} of 15 problems.",
            beaten == 0,
            "So it is under every reading of what the paper leaves open that was tried. Either its runs had not "
            "converged, or its criterion was another: a band of 2 % comes near for three of the fifteen.",
        ),
        Claim(
            "The swarm, with the parameters of the paper, finds settings that are near the best.",
            f"Better than the printed one in {better} of 15 problems, within 1 % of the best known in {close} of the "
            "10 that are not of weighting Duration.",
            better == 15 and close == 10,
        ),
        Claim(
            "ME-PSO-Duration settles fastest.",
            "Fastest: " + ", ".join(f"{name} {method}" for name, method in fastest.items()) + ".",
            set(fastest.values()) == {"ME-PSO-Duration"},
            "On G5 the printed times of the ME-PSO rows are a dead time short; on G4 the printed table itself has 0.6 "
            "s for Skogestad and 0.7 s for ME-PSO-Duration.",
        ),
        Claim(
            "On G5 ME-PSO-Duration settles 1.7 to 25 times faster than the classical rules.",
            f"{min(slowest) / theirs:.1f} to {max(slowest) / theirs:.1f} times.",
            min(slowest) / theirs > 1.6,
            "Its printed time is a dead time short, and the exact answer leaves the band once more.",
        ),
        Claim(
            "ME-PSO-Duration overshoots by 4.2 % at most.",
            "Overshoot: " + ", ".join(f"{name} {x:.1f}" for name, x in overshoots.items()) + " %.",
            max(overshoots.values()) < 4.3,
            "The printed table itself has 28 % on G4.",
        ),
        Claim(
            "Tyreus-Luyben does not apply to G1, and Cohen-Coon fails on G5.",
            "Both are refused: G1 has no ultimate point, and the other loop would be unstable.",
            _refused(references, "G1", "Tyreus-Luyben") and _refused(references, "G5", "Cohen-Coon"),
        ),
    )


def _classical(references: References, name: str) -> list[str]:
    return [method for method in printed_rows(references, name) if not method.startswith("ME-PSO")]


def _refused(references: References, name: str, rule: str) -> bool:
    try:
        by_rule(references, name, rule)
    except Refused:
        return True
    return False
