"""Plots of the step responses behind the papers' figures and tables, one small PNG each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model
from loopwright.tuning.rules.registry import tune
from loopwright.tuning.rules.robust_pi import optimise
from validation import direct_synthesis, five_stage, imc, me_pso, reactor, s_plane
from validation.loops import FIVE_LAGS, ideal_pid, of_numerator, plant, sopdt
from validation.references import References

SIZE_IN = (7.2, 3.4)
DPI = 80
POINTS = 1200

Panel = tuple[str, Model, dict[str, Gains], float]
"""Title, plant, settings by label, length in s."""
ME_PSO_SHOWN = ("ME-PSO-Error", "ME-PSO-Control", "ME-PSO-Duration", "Skogestad", "Ziegler-Nichols", "AMIGO")
ME_PSO_LENGTH_S = {"G1": 15.0, "G2": 25.0, "G3": 25.0, "G4": 3.0, "G5": 25.0}


IMC_CASE_1 = "imc-case-1"


def draw(references: References, folder: Path) -> None:
    """All of them, by the names that the papers' checks give."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, panels in _panels(references).items():
        _save(_figure(panels), folder / f"{name}.png")
    _save(_imc_case_1(references), folder / f"{IMC_CASE_1}.png")


def names(references: References) -> set[str]:
    """Of the files that are drawn, without ending."""
    return {*_panels(references), IMC_CASE_1}


def _panels(references: References) -> dict[str, list[Panel]]:
    groups: tuple[Callable[[References], dict[str, list[Panel]]], ...] = (
        _five_stage,
        _direct_synthesis,
        _imc_case_2,
        _s_plane,
        _me_pso,
    )
    return {name: panels for group in groups for name, panels in group(references).items()}


def _five_stage(references: References) -> dict[str, list[Panel]]:
    tables = references.five_stage
    printed = {row["model"]: row["printed"] for row in tables["table2"]["rows"]}
    controllers = {
        "of the plant itself" if name == "original" else f"of model {name}": Gains(p["kp"], p["kp"] / p["ki"])
        for name, p in printed.items()
    }
    table_4: list[Panel] = []
    for m in tables["table4"]["models_settled"]:
        model = five_stage.table_4_model(tables["table4"], m["id"])
        settings = {
            "ZN-2": Gains(0.9 * model.T / (model.K * model.L), 3.0 * model.L),
            "optimised": optimise(model, horizon_s=five_stage.TABLE_4_HORIZON_S).gains,
        }
        table_4.append((f"{m['id']}: tau = {model.L:g} s", model, settings, 40.0))
    return {
        "five-stage-table-2": [("1/(s+1)^5 under the six controllers", FIVE_LAGS, controllers, 40.0)],
        "five-stage-table-4": table_4,
        "five-stage-reactor": [
            (
                "Reactor, linearised; PV in mol/m3",
                reactor.linear_reactor(),
                reactor.controllers(tables["reactor"]),
                250.0,
            )
        ],
    }


def _direct_synthesis(references: References) -> dict[str, list[Panel]]:
    def panel(name: str, settings: dict[str, Gains], length_s: float) -> Panel:
        return f"Object ({name[1:]})", sopdt(references, name), settings, length_s

    printed, rules = direct_synthesis.printed_settings, direct_synthesis.rules_settings
    return {
        "direct-synthesis-figure-4": [panel("P30", printed(references, "P30"), 30.0)],
        "direct-synthesis-figure-5": [panel("P31", printed(references, "P31"), 40.0)],
        "direct-synthesis-figures-6-7": [
            panel("P32", rules(references, "P32"), 300.0),
            panel("P33", rules(references, "P33"), 6000.0),
        ],
    }


def _imc_case_2(references: References) -> dict[str, list[Panel]]:
    model = imc.case_2(references)
    copied = references.more["imc"]["settings42"]
    settings = {
        "(42) as printed": ideal_pid(copied["Kp"], copied["Ti"], copied["Td"]),
        "(36), psi = 50 s, lambda = 7.4 s": tune("imc-pid", model, psi_s=50.0, lambda_s=7.4, extrapolate=True).gains,
    }
    return {"imc-case-2": [("Case 2, 0.2 exp(-7.4 s)/s", model, settings, 600.0)]}


def _s_plane(references: References) -> dict[str, list[Panel]]:
    plants, printed = s_plane.objects(references), references.search["paper_a"]["printed"]
    return {
        f"s-plane-table-{i}": [
            (
                title,
                plants[name],
                {f"mu = {row['mu']}": of_numerator(row["C"]) for row in printed[table]},
                length_s,
            )
        ]
        for i, name, table, title, length_s in (
            (1, "first", "table1_first", "First order, PI", 40.0),
            (2, "second_identified", "table2_second", "Second order, PI", 30.0),
            (3, "third", "table3_third", "Third order, PID", 10.0),
        )
    }


def _me_pso(references: References) -> dict[str, list[Panel]]:
    found: dict[str, list[Panel]] = {}
    for name, formula in me_pso.PLANTS.items():
        rows = me_pso.printed_rows(references, name)
        # a pure integral controller, in the ISA form its limit
        settings = {m: Gains(max(rows[m][0], 1e-6), max(rows[m][0], 1e-6) * rows[m][1]) for m in ME_PSO_SHOWN}
        model = plant(references.search["paper_b"]["plants"][name])
        found[f"me-pso-{name.lower()}"] = [(f"{name} = {formula}", model, settings, ME_PSO_LENGTH_S[name])]
    return found


def _figure(panels: list[Panel]) -> Figure:
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for i, (ax, (title, model, settings, length_s)) in enumerate(zip(axes, panels, strict=True)):
        ax.axhline(1.0, color="0.6", linewidth=0.8)
        for label, gains in settings.items():
            response = step_response(model, gains, horizon=length_s, dt=length_s / POINTS)
            ax.plot(response.t, response.y, label=label, linewidth=1.4)
        ax.set(title=title, xlabel="t, s", xlim=(0.0, length_s))
        ax.title.set_fontsize(10)
        ax.grid(alpha=0.3)
        if i == 0:
            ax.set_ylabel("PV, step of the set-point = 1")
    axes[-1].legend(fontsize=8, loc="lower right")
    return figure


def _imc_case_1(references: References) -> Figure:
    model, lambda_s = imc.case_1(references)
    gains = tune("imc-pid", model, lambda_s=lambda_s).gains
    errors = {
        "IMC-PID": imc.setpoint_error(model, gains),
        "IMC, first-order filter": imc.ideal_imc_error(model, lambda_s),
    }
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    for (label, (t, error)), style in zip(errors.items(), ("-", "--"), strict=True):
        every = np.arange(0, len(t), max(1, len(t) // POINTS))
        left.plot(t[every], 1.0 - error[every], style, label=label)
        right.plot(t[every], imc.disturbed(t, error)[every], style, label=label)
    left.set(title="set-point step", xlabel="t, s", ylabel="PV", xlim=(0.0, 150.0))
    right.set(title="disturbance 0.25/(30 s + 1)", xlabel="t, s", xlim=(0.0, 150.0))
    for ax in (left, right):
        ax.title.set_fontsize(10)
        ax.grid(alpha=0.3)
    right.legend(fontsize=8)
    return figure


def _save(figure: Figure, path: Path) -> None:
    # no version of the library in the file: the same picture is the same bytes
    FigureCanvasAgg(figure).print_figure(path, dpi=DPI, metadata={"Software": None})
