"""Plots of the step responses behind the papers' figures and tables, one small PNG each, in the look of all plots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from loopwright.service.cli.plots import style
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals
from loopwright.tuning.rules.registry import tune
from loopwright.tuning.rules.robust_pi import optimise
from validation import direct_synthesis, five_stage, imc, me_pso, reactor, s_plane
from validation.loops import FIVE_LAGS, ideal_pid, of_numerator, plant, sopdt
from validation.references import References

SIZE_IN = (7.6, 3.5)
POINTS = 1200
NAMED, SHORT = 3, 16
"""Largest number of curves, and of letters of their names, that have their names at the lines; others have them beside
the panels."""

Curves = list[tuple[str, Reals, Reals]]
"""Name, times, s, and values of each."""
Panel = tuple[str, Model, dict[str, Gains], float]
"""Title, plant, settings by label, length in s."""
ME_PSO_SHOWN = ("ME-PSO-Error", "ME-PSO-Control", "ME-PSO-Duration", "Skogestad", "Ziegler-Nichols", "AMIGO")
ME_PSO_LENGTH_S = {"G1": 15.0, "G2": 25.0, "G3": 25.0, "G4": 3.0, "G5": 25.0}


IMC_CASE_1 = "imc-case-1"


def draw(references: References, folder: Path) -> None:
    """All of them, by the names that the papers' checks give."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, panels in _panels(references).items():
        style.write(_figure(panels), folder / f"{name}.png")
    style.write(_imc_case_1(references), folder / f"{IMC_CASE_1}.png")


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
            "optimised": optimise(model, horizon_s=five_stage.TABLE_4_HORIZON_S).gains,
            "ZN-2": Gains(0.9 * model.T / (model.K * model.L), 3.0 * model.L),
        }
        table_4.append((f"{m['id']}: tau = {model.L:g} s", model, settings, 40.0))
    return {
        "five-stage-table-2": [("1/(s+1)^5 under the six controllers", FIVE_LAGS, controllers, 40.0)],
        "five-stage-table-4": table_4,
        "five-stage-reactor": [
            (
                "Reactor, linearised; PV in mol/m3",
                reactor.linear_reactor(),
                _foremost("optimised", reactor.controllers(tables["reactor"])),
                250.0,
            )
        ],
    }


def _foremost(name: str, settings: dict[str, Gains]) -> dict[str, Gains]:
    """The settings with this one first, which is drawn as what a paper is about."""
    return {name: settings[name], **settings}


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
        "(36), psi = 50 s, lambda = 7.4 s": tune("imc-pid", model, psi_s=50.0, lambda_s=7.4, extrapolate=True).gains,
        "(42) as printed": ideal_pid(copied["Kp"], copied["Ti"], copied["Td"]),
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
    figure = style.new_figure(*SIZE_IN)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (title, model, settings, length_s) in zip(axes, panels, strict=True):
        ax.axhline(1.0, color=style.SETPOINT, linewidth=0.8, linestyle=":")
        answers = {
            name: step_response(model, gains, horizon=length_s, dt=length_s / POINTS)
            for name, gains in settings.items()
        }
        curves = [(name, each.t, each.y) for name, each in answers.items()]
        _curves(ax, title, curves, length_s, named=ax is axes[-1])
    axes[0].set_ylabel("PV, step of the set-point = 1")
    _legend(figure, axes[-1])
    return figure


def _imc_case_1(references: References) -> Figure:
    model, lambda_s = imc.case_1(references)
    gains = tune("imc-pid", model, lambda_s=lambda_s).gains
    errors = {
        "IMC-PID": imc.setpoint_error(model, gains),
        "IMC, first-order filter": imc.ideal_imc_error(model, lambda_s),
    }
    figure = style.new_figure(*SIZE_IN)
    left, right = figure.subplots(1, 2)
    after_step: Curves = []
    after_disturbance: Curves = []
    for label, (t, error) in errors.items():
        every = np.arange(0, len(t), max(1, len(t) // POINTS))
        after_step.append((label, t[every], 1.0 - error[every]))
        after_disturbance.append((label, t[every], imc.disturbed(t, error)[every]))
    left.axhline(1.0, color=style.SETPOINT, linewidth=0.8, linestyle=":")
    right.axhline(0.0, color=style.SETPOINT, linewidth=0.8, linestyle=":")
    _curves(left, "set-point step", after_step, 150.0)
    _curves(right, "disturbance 0.25/(30 s + 1)", after_disturbance, 150.0)
    left.set_ylabel("PV")
    _legend(figure, right)
    return figure


def _curves(axes: Axes, title: str, curves: Curves, length_s: float, named: bool = False) -> None:
    """Draws the curves of a panel. named: with their names at the lines, where they are few."""
    axes.set_xlim(0.0, length_s)
    for (name, t, y), (colour, line) in zip(curves, style.CURVES, strict=False):
        axes.plot(t, y, color=colour, linestyle=line, linewidth=1.5, label=name)
    if named and _at_the_lines([name for name, _, _ in curves]):
        style.name_curves(
            axes, [(name, colour, t, y) for (name, t, y), (colour, _) in zip(curves, style.CURVES, strict=False)]
        )
    axes.set_title(title, fontsize=10)
    style.plain(axes, "", "time, s")


def _legend(figure: Figure, axes: Axes) -> None:
    """Names the curves beside the panels, where they are many or have long names."""
    lines, names = axes.get_legend_handles_labels()
    if not _at_the_lines(names):
        figure.legend(lines, names, loc="outside right upper", fontsize=8.5, frameon=False, handlelength=3.2)


def _at_the_lines(names: Sequence[str]) -> bool:
    return len(names) <= NAMED and all(len(name) <= SHORT for name in names)
