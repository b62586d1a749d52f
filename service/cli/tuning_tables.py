"""Methods, tunings and identified models on a terminal."""

from __future__ import annotations

import json
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from loopwright.service.inputs.model_json import describe

console = Console(highlight=False)

MAX_CANDIDATES = 8
_COLUMNS = (
    ("", "Kp", "gains"),
    ("", "Ti", "gains"),
    ("", "Td", "gains"),
    ("", "Ms", "margins"),
    ("", "GM", "margins"),
    ("PM", "PM_deg", "margins"),
    ("over\nshoot", "overshoot_pct", "setpoint"),
    ("sett\nling", "settling_s", "setpoint"),
    ("IAE\nSP", "IAE", "setpoint"),
    ("peak\nload", "peak", "load"),
    ("IAE\nload", "IAE", "load"),
)


def methods(found: list[dict[str, Any]]) -> None:
    """Each method: what it is for, what it needs, its options."""
    for method in found:
        console.print(f"[bold]{method['method']}[/bold]  {method['title']}")
        console.print(
            f"  {escape(method['for_what'])}\n  Takes {escape(method['needs'])}.\n  {escape(method['source'])}"
        )
        for name, option in method["options"].items():
            console.print(f"    {name}: {escape(_option(option))}")
    console.print(
        "\n`loopwright tune --model ... --method NAME --option NAME=VALUE` uses one; --method all compares them."
    )


def tunings(answer: dict[str, Any]) -> None:
    """A line for each method that gave gains; below it the refusals and what there is to know."""
    tuned = [each for each in answer["methods"] if each["outcome"] == "tuned"]
    refused = [each for each in answer["methods"] if each["outcome"] == "refused"]
    console.print(f"Model {escape(describe(answer['model']))}")
    if tuned:
        table = Table("method", box=None, padding=(0, 0, 0, 1), pad_edge=False)
        for heading, name, _ in _COLUMNS:
            table.add_column(heading or name, justify="right")
        for each in tuned:
            cells = [_cell(name, (each[part] or {}).get(name)) for _, name, part in _COLUMNS]
            if not each["margins"]["stable"]:
                cells[3:] = ["unstable", *[""] * (len(cells) - 4)]
            table.add_row(each["method"], *cells)
        console.print(table)
        console.print(
            "Kp: MV per PV unit, ISA form; times: s; PM: degrees; overshoot: %; settling: to 2 %; IAE and peak: of "
            "unit steps of the set-point and of the load at the plant's input. Figures are of these gains on the model "
            "with its exact dead time; an ideal derivative has got a filter first."
        )
    if refused:
        console.print("\nRefused:")
        _hanging([(each["method"], f"{each['reason']}: {each['detail']}") for each in refused])
    if len(tuned) == 1:
        chosen = ", ".join(f"{name} {short(value)}" for name, value in tuned[0]["chosen"].items())
        Kp, Ki, Kd = (short(tuned[0]["parallel"][name]) for name in ("Kp", "Ki", "Kd"))
        console.print(f"\nParallel form: Kp {Kp}, Ki {Ki} per s, Kd {Kd} s" + (f"\nChosen: {chosen}" if chosen else ""))
    notes: dict[str, list[str]] = {}
    for each in tuned:
        for note in each["notes"]:
            notes.setdefault(note, []).append(each["method"])
    if notes:
        console.print("\nNotes:")
        _hanging([(", ".join(who), note) for note, who in notes.items()])


def to_try(found: dict[str, Any]) -> None:
    """How the gains of one method, or Ms, are tried on the loop."""
    if len(found["methods"]) == 1 and (wish := found["methods"][0]["retune"]):
        console.print(
            f"\nTo try them on the loop: POST /loops/{escape(found['loop'])}/retune with\n{json.dumps(wish)}",
            markup=False, soft_wrap=True,
        )  # fmt: skip


def identified(answer: dict[str, Any]) -> None:
    """The model with its standard errors, how well it fits, and its rivals."""
    if answer["outcome"] == "refused":
        console.print(f"[bold]{answer['reason']}[/bold]: {escape(answer['detail'])}\n{answer['advice']}")
        return
    console.print(f"Model {escape(describe(answer['model']))}")
    table = Table("", "value", "standard error", box=box.SIMPLE_HEAD, pad_edge=False)
    for name, error in answer["standard_errors"].items():
        table.add_row(escape(name), number(answer["parameters"][name]), number(error))
    console.print(table)
    white = "explains it" if answer["explained"] else "leaves a part unexplained"
    console.print(
        f"Fit {answer['fit_pct']:.2f} % (R2 {answer['r2_pct']:.3f} %) of {answer['samples']} samples; "
        f"the model {white}; noise {number(answer['noise_std'])} PV units"
    )
    table = Table(
        "structure", "BIC", "rms", "parameters", "from rest", "beside MV", "", box=box.SIMPLE_HEAD, pad_edge=False
    )
    for i, each in enumerate(answer["candidates"]):
        if i < MAX_CANDIDATES or each["chosen"]:
            table.add_row(
                each["structure"], f"{each['bic']:.1f}", number(each["rms"]), str(each["parameters"]),
                "yes" if each["at_rest"] else "no", _beside(each), "chosen" if each["chosen"] else "",
            )  # fmt: skip
    console.print(table)
    if len(answer["candidates"]) > MAX_CANDIDATES:
        console.print(f"{len(answer['candidates'])} were tried; --json has them all.")
    console.print("For `loopwright tune --model`: " + json.dumps(answer["model"]), markup=False, soft_wrap=True)
    for note in answer["notes"]:
        console.print(f"note: {note}", markup=False)


def _beside(candidate: dict[str, Any]) -> str:
    """What is said to have moved PV beside MV."""
    loads = ("", "a load", "two loads")[candidate["loads"]]
    return "a drift" if candidate["drift"] else loads


def _cell(name: str, value: float | None) -> str:
    # a percentage has no digits to show below rounding
    return short(round(value, 6) if value is not None and name.endswith("_pct") else value)


def number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def short(value: float | None) -> str:
    """Three digits, without an exponent while they are readable."""
    if value is None:
        return "-"
    rounded = float(f"{value:.3g}")
    return f"{rounded:.0f}" if 100.0 <= abs(rounded) < 1e6 else f"{rounded:.3g}"


def _option(option: dict[str, Any]) -> str:
    unit = f", {option['unit']}" if option["unit"] else ""
    default = "" if option["default"] is None else f"; default {_plain(option['default'])}"
    choices = f"; {', '.join(_plain(each) for each in option['choices'])}" if option["choices"] else ""
    return f"{option['meaning']}{unit}{choices}{default}"


def _plain(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def _hanging(lines: list[tuple[str, str]]) -> None:
    grid = Table.grid(padding=(0, 1))
    grid.add_column(max_width=24)
    grid.add_column()
    for left, right in lines:
        grid.add_row(escape(left), escape(right))
    console.print(grid)
