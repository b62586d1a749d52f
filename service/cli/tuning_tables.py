"""Shows methods, tunings and identified models on a terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from loopwright.service.api.tuning_views import AlternativesView, FiguresView, MarginsView, TunedView, TuningsView
from loopwright.service.inputs.model_json import describe, dump_model
from loopwright.service.offline.controller_forms import EQUATIONS, ISA_IN_S, Faceplate
from loopwright.service.offline.identification import named
from loopwright.tuning.identification.identify import Candidate, Identified
from loopwright.tuning.models import sign
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.registry import Method, Option

console = Console(highlight=False, markup=False, emoji=False)

MAX_CANDIDATES = 8
BOLD = "bold"
_UNBOUNDED = 10_000
"""More columns than any table has."""
_COLUMNS = (
    ("Ms\n", "Ms", "margins"),
    ("GM\n", "GM", "margins"),
    ("PM\ndeg", "PM_deg", "margins"),
    ("over-\nshoot %", "overshoot_pct", "setpoint"),
    ("settling\ns", "settling_s", "setpoint"),
    ("IAE\nSP", "IAE", "setpoint"),
    ("peak\nload", "peak", "load"),
    ("IAE\nload", "IAE", "load"),
)
_LEAST_NEEDED = ("peak\nload", "IAE\nSP", "PM\ndeg", "settling\ns", "GM\n", "IAE\nload", "over-\nshoot %")
"""The columns that a terminal too narrow for all of them leaves out, the least needed first."""


def methods(found: Iterable[Method]) -> None:
    """Shows what each method is for, the models that it takes, and its options."""
    for method in found:
        console.print(Text.assemble((method.name, BOLD), f"  {method.title}"))
        console.print(f"  {method.for_what}\n  Takes {method.needs}.\n  {method.source}")
        for name, option in method.options.items():
            console.print(f"    {name}: {_option(option)}")
    console.print(
        "\n`loopwright tune --model ... --method NAME --option NAME=VALUE` uses one method; --method all compares all."
    )


def tunings(answer: TuningsView | AlternativesView, faceplate: Faceplate = ISA_IN_S) -> None:
    """Shows a line for each method that gave gains; below them the recommended one, the refusals and the notes.

    faceplate: how the gains are shown.
    """
    tuned = [each for each in answer.methods if each.outcome == "tuned"]
    refused = [each for each in answer.methods if each.outcome == "refused"]
    console.print(f"Model {describe(answer.model.model_dump())}")
    first = answer.recommended if isinstance(answer, TuningsView) else None
    if tuned:
        left_out = _show_figures(tuned, faceplate, first.method if first else None)
        if left_out:
            console.print(f"A wider terminal, and --json, also show {', '.join(left_out)}.")
        console.print(
            f"Controller {EQUATIONS[faceplate.form]}; overshoot and settling (to 2 %) of "
            "a step of the set-point; IAE and peak for unit steps of the set-point and of the load at the plant's "
            "input, with these gains on the model with its exact dead time; an ideal derivative is filtered first.",
        )
        if sign(answer.model.plant()) < 0.0:
            console.print("The plant's gain is negative: the controller acts directly. Kp is given positive.")
    if first:
        console.print(Text.assemble(("\n* " + first.method, BOLD), f" is recommended: {first.reason}."))
    if refused:
        _refusals(refused)
    if len(tuned) == 1 and faceplate == ISA_IN_S:
        _parallel_form(tuned[0])
    notes: dict[str, list[str]] = {}
    for each in tuned:
        for note in each.notes:
            notes.setdefault(note, []).append(each.method)
    if notes:
        console.print("\nNotes:")
        _hanging([(", ".join(who), note) for note, who in notes.items()])


def _show_figures(tuned: Sequence[TunedView], faceplate: Faceplate, recommended: str | None) -> list[str]:
    """Shows the gains and figures of each method, and returns the names of the figures for which there is no place."""
    whole = console.options.update(width=_UNBOUNDED)
    weights = any(each.gains is not None and each.gains.b != 1.0 for each in tuned)
    places = [(_LEAST_NEEDED[:count], weights) for count in range(len(_LEAST_NEEDED) + 1)]
    for left_out, weighted in [*places, (_LEAST_NEEDED, False)]:
        shown = [each for each in _COLUMNS if each[0] not in left_out]
        table = _table(tuned, faceplate, recommended, shown, weighted)
        if console.measure(table, options=whole).maximum <= console.width:
            break
    console.print(table)
    return ["b"] * (weights and not weighted) + [
        heading.replace("-\n", "").replace("\n", " ").strip() for heading, *_ in _COLUMNS if heading in left_out
    ]


def _table(
    tuned: Sequence[TunedView],
    faceplate: Faceplate,
    recommended: str | None,
    shown: Sequence[tuple[str, str, str]],
    weighted: bool,
) -> Table:
    """The gains and figures of each method, with the units in the second line of the headings. weighted: with b."""
    table = Table(Column("method", no_wrap=True), box=None, padding=(0, 0, 0, 1), pad_edge=False)
    for name, unit in faceplate.columns:
        table.add_column(f"{name}\n{unit}", justify="right", overflow="fold")
    for heading in (*["b"] * weighted, *(heading for heading, _, _ in shown)):
        table.add_column(heading, justify="right", overflow="fold")
    for each in tuned:
        parts = {"margins": each.margins, "setpoint": each.setpoint, "load": each.load}
        cells = [_cell(name, _figure(parts[part], name)) for _, name, part in shown]
        if each.margins is None or not each.margins.stable:
            cells = ["unstable", *[""] * (len(cells) - 1)]
        numbers = None if each.gains is None else faceplate.numbers(each.gains.gains())
        gains = ["-"] * 3 if numbers is None else [short(value) for value in numbers]
        if weighted:
            gains.append("-" if each.gains is None else short(each.gains.b))
        mark = "* " if each.method == recommended else ""
        table.add_row(f"{mark}{each.method}", *gains, *cells, style=BOLD if mark else None)
    return table


def _refusals(refused: Sequence[TunedView]) -> None:
    """Shows the methods that refused by their reason: one alone with its numbers, several with what to do."""
    console.print("\nRefused:")
    reasons: dict[Reason, list[TunedView]] = {}
    for each in refused:
        if each.reason is not None:
            reasons.setdefault(each.reason, []).append(each)
    for reason, those in reasons.items():
        if len(those) == 1:
            text = f"{reason.value}: {those[0].detail}"
        else:
            text = f"{reason.value}: {those[0].advice} (what each takes: `loopwright methods`)"
        _hanging([(", ".join(each.method for each in those), text)])


def _parallel_form(each: TunedView) -> None:
    design = ", ".join(f"{name} {short(value)}" for name, value in (each.design or {}).items())
    if each.parallel is not None:
        Kp, Ki, Kd = (short(value) for value in (each.parallel.Kp, each.parallel.Ki, each.parallel.Kd))
        console.print(f"\nParallel form: Kp {Kp}, Ki {Ki} per s, Kd {Kd} s" + (f"\nDesign: {design}" if design else ""))


def to_try(found: AlternativesView) -> None:
    """Shows how to try the gains on the loop, where there are gains of one method or for one Ms."""
    if len(found.methods) != 1 or not (body := found.methods[0].retune):
        return
    ms = body.get("Ms")
    wanted = f"--ms {ms:g}" if isinstance(ms, int | float) else f"--method {found.methods[0].method}"
    if body.get("derivative"):
        wanted += " --derivative"
    if isinstance(aim := body.get("aim"), str) and aim != "balanced":
        wanted += f" --aim {aim}"
    for name in ("settling_s", "mv_peak", "noise_gain"):
        if isinstance(value := body.get(name), int | float):
            wanted += f" --{name.replace('_', '-')} {value:g}"
    console.print(
        f"\nTo try them on the loop: loopwright retune {found.loop} --from {found.job} {wanted}\n"
        f"or POST /loops/{found.loop}/retune with\n{json.dumps(body)}",
        soft_wrap=True,
    )  # fmt: skip


def not_identified(refusal: Refused) -> None:
    """Shows why no model was identified."""
    console.print(Text.assemble((refusal.reason.value, BOLD), f": {refusal.detail}\n{refusal.advice}"))


def identified(found: Identified, samples: int) -> None:
    """Shows the model with its standard errors, how well it fits, and the other candidate models.

    samples: the number of samples of the record.
    """
    model, parameters = dump_model(found.model), named(found.parameters)
    console.print(f"Model {describe(model)}")
    table = Table("", "value", "standard error", box=box.SIMPLE_HEAD, pad_edge=False)
    for name, error in named(found.standard_errors).items():
        table.add_row(name, number(parameters[name]), number(error))
    console.print(table)
    white = "explains the record" if found.explained else "does not explain all of the record"
    console.print(
        f"Fit {found.fit_pct:.2f} % (R2 {found.r2_pct:.3f} %) of {samples} samples; "
        f"the model {white}; noise {number(found.noise_std)} PV units"
    )
    table = Table(
        "structure", "BIC", "rms", "parameters", "from rest", "disturbance", "", box=box.SIMPLE_HEAD, pad_edge=False
    )
    for i, each in enumerate(found.candidates):
        if i < MAX_CANDIDATES or each.chosen:
            table.add_row(
                each.structure, f"{each.bic:.1f}", number(each.rms), str(each.parameters),
                "yes" if each.at_rest else "no", _disturbance(each), "chosen" if each.chosen else "",
            )  # fmt: skip
    console.print(table)
    if len(found.candidates) > MAX_CANDIDATES:
        console.print(f"{len(found.candidates)} candidate models were fitted; --json has them all.")
    console.print("For `loopwright tune --model`: " + json.dumps(model), soft_wrap=True)
    for note in found.notes:
        console.print(f"note: {note}")


def _disturbance(candidate: Candidate) -> str:
    """Returns the disturbance hypothesis of a candidate model in words."""
    loads = ("", "a load", "two loads")[candidate.loads]
    return "a drift" if candidate.drift else loads


def _figure(part: MarginsView | FiguresView | None, name: str) -> float | None:
    value = getattr(part, name, None)
    return value if isinstance(value, int | float) else None


def _cell(name: str, value: float | None) -> str:
    # rounding removes the numerical noise of a percentage that is 0
    return short(round(value, 6) if value is not None and name.endswith("_pct") else value)


def number(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.4g}"


def short(value: float | None) -> str:
    """Returns a number with three digits, without an exponent below a million."""
    if value is None:
        return "-"
    rounded = float(f"{value:.3g}")
    return f"{rounded:.0f}" if 100.0 <= abs(rounded) < 1e6 else f"{rounded:.3g}"


def _option(option: Option) -> str:
    unit = f", {option.unit}" if option.unit else ""
    default = "" if option.default is None else f"; default {_plain(option.default)}"
    choices = f"; {', '.join(_plain(each) for each in option.choices)}" if option.choices else ""
    return f"{option.meaning}{unit}{choices}{default}"


def _plain(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def _hanging(lines: list[tuple[str, str]]) -> None:
    grid = Table.grid(padding=(0, 1))
    grid.add_column(max_width=24)
    grid.add_column()
    for left, right in lines:
        grid.add_row(left, right)
    console.print(grid)
