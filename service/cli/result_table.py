"""Shows the figures of a result, of a job or of a rehearsal, as a table."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import BaseModel, ConfigDict
from rich.table import Table

from loopwright.service.cli import terminal
from loopwright.service.cli.terminal import cell, figure
from loopwright.service.results import (
    ComparisonView,
    EvidenceView,
    GainsView,
    ModelView,
    PredictedView,
    StepView,
    TransferModelView,
    UltimateView,
    VerificationView,
)

_MARGINS = (("GM", "GM", ""), ("PM", "PM_deg", "deg"), ("Ms", "Ms", ""))
_PREDICTED = (
    ("overshoot", "overshoot_pct", "%"),
    ("settling", "settling_s", "s"),
    ("IAE, unit step", "IAE_per_unit", "s"),
    *_MARGINS,
)
"""Figures of a job of an earlier version, which has no comparison."""
_NOTHING = ("", "-")
_MS_SHOWN = 0.001


class ShownResult(BaseModel):
    """What a table shows of a result: of a job, or of a rehearsal of a plant file."""

    model_config = ConfigDict(from_attributes=True)

    previous_gains: GainsView | None = None
    new_gains: GainsView | None = None
    step_before: StepView | None = None
    step_after: StepView | None = None
    comparison: ComparisonView | None = None
    predicted: PredictedView | None = None
    predicted_previous: PredictedView | None = None
    model: ModelView | TransferModelView | None = None
    model_from: str | None = None
    tested_on_loop: bool | None = None
    evidence: EvidenceView | None = None
    verification: VerificationView | None = None
    ultimate: UltimateView | None = None
    plant_time_s: float


def result_table(
    shown: ShownResult, title: str | None, heading_new: str, pv_unit: str = "PV unit", mv_unit: str = "%"
) -> None:
    """Shows the figures of a result that are known.

    heading_new: what the new gains are called.
    """
    table = Table(title=title)
    for heading in ("", "previous", heading_new, "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for label, before, after, unit in _figures(shown, pv_unit, mv_unit):
        if before not in _NOTHING or after not in _NOTHING:
            table.add_row(label, before, after, unit)
    if table.row_count > 1:  # the plant time alone is no result
        terminal.console.print(table)
        if shown.model_from is not None:
            terminal.console.print(f"The model is from {shown.model_from}.", highlight=False)


def weighted(*gains: GainsView | None) -> bool:
    """Returns whether any of these gains has a set-point weight b other than one, which is then shown."""
    return any(each is not None and each.b != 1.0 for each in gains)


def _figures(job: ShownResult, pv_unit: str, mv_unit: str) -> Iterator[tuple[str, str, str, str]]:
    """Yields lines of the table: label, before, after, unit."""
    per = f"{mv_unit} per {pv_unit}"
    if job.new_gains is not None:
        for name, unit in (("Kp", f"{per} (ISA)"), ("Ti", "s"), ("Td", "s")):
            yield f"gain {name}", figure(job.previous_gains, name), figure(job.new_gains, name), unit
        if weighted(job.previous_gains, job.new_gains):
            yield "set-point weight b", figure(job.previous_gains, "b"), figure(job.new_gains, "b"), ""
    if job.step_before or job.step_after:
        for label, name, unit in (
            ("measured IAE", "IAE", f"{pv_unit} s"),
            ("measured overshoot", "overshoot_pct", "%"),
            ("measured settling", "settling_s", "s"),
        ):
            yield label, figure(job.step_before, name), figure(job.step_after, name), unit
    for label, was, now, unit in _predicted(job, pv_unit, mv_unit):
        yield f"predicted {label}", was, now, unit
    for label, value, unit in (*_model(job.model, pv_unit, mv_unit), *_certainty(job, mv_unit)):
        yield label, "", value, unit
    if job.ultimate is not None:
        yield "ultimate Ku, Pu", "", ", ".join(figure(job.ultimate, n) for n in ("Ku", "Pu_s")), f"{per}, s"
    yield "plant time", "", cell(job.plant_time_s), "s"


def _asked(compared: ComparisonView, name: str) -> float | None:
    """Returns the largest value that was asked for of a figure of the set-point step."""
    return {"settling_s": compared.settling_s_asked, "mv_peak": compared.mv_peak_asked}.get(name)


def _predicted(job: ShownResult, pv_unit: str, mv_unit: str) -> Iterator[tuple[str, str, str, str]]:
    """Yields lines of the table: label, before, after, unit."""
    compared = job.comparison
    if compared is None:
        earlier = job.predicted_previous
        for label, name, unit in _PREDICTED if earlier or not job.step_after else _MARGINS:
            yield label, "" if earlier is None else figure(earlier, name), figure(job.predicted, name), unit
        return
    for label, part, name, unit in (
        ("overshoot", None, "overshoot_pct", "%"),
        ("settling, set-point", "setpoint", "settling_s", "s"),
        ("IAE, set-point", "setpoint", "IAE", "s"),
        ("MV travel, set-point", "setpoint", "TV", f"{mv_unit} per {pv_unit}"),
        ("MV peak, set-point", "setpoint", "mv_peak", f"{mv_unit} per {pv_unit}"),
        ("peak, load", "load", "peak", f"{pv_unit} per {mv_unit}"),
        ("settling, load", "load", "settling_s", "s"),
        ("IAE, load", "load", "IAE", f"{pv_unit} s per {mv_unit}"),
        ("MV travel, load", "load", "TV", f"{mv_unit} per {mv_unit}"),
        *((label, None, name, unit) for label, name, unit in _MARGINS),
    ):
        asked = _asked(compared, name) if part == "setpoint" else None
        if asked is not None:
            label = f"{label}, at most {cell(asked)}"
        elif name == "mv_peak":  # a row for who asked for it
            continue
        shown = []
        for each in (compared.previous, compared.new):
            of = getattr(each, part) if part else each
            shown.append(cell(getattr(of, name)) if each.stable else "unstable")
        yield label, shown[0], shown[1], unit
    yield "J, the cost minimised", cell(compared.J_previous), cell(compared.J_new), ""


def _model(model: ModelView | TransferModelView | None, pv_unit: str, mv_unit: str) -> Iterator[tuple[str, str, str]]:
    """Yields lines of the table: label, value, unit."""
    if isinstance(model, ModelView):
        for name, field, unit in (("K", "K", f"{pv_unit} per {mv_unit}"), ("T", "T_s", "s"), ("L", "L_s", "s")):
            yield f"model {name}", figure(model, field), unit
    elif model is not None:
        for each in model.parameters:
            unit = each.unit.replace("PV", pv_unit).replace("MV", mv_unit).replace("/", " per ")
            yield f"model {each.name}", _with_error(each.value, each.error), unit
        if not model.parameters:
            yield "model num", " ".join(map(_with_error, model.num, model.num_errors or [0.0] * len(model.num))), ""
            yield "model den", " ".join(map(_with_error, model.den, model.den_errors or [0.0] * len(model.den))), ""
            yield "model dead time", _with_error(model.dead_time_s, model.dead_time_error_s), "s"


def _with_error(value: float, error: float | None) -> str:
    """Returns a value with its standard error, unless the error is negligible."""
    return cell(value) if not error or error < 1e-4 * abs(value) else f"{cell(value)}±{error:.1g}"


def _of_ms(difference: float | None) -> str:
    """Returns a difference of Ms as text, to a thousandth: nobody can tell less from a loop."""
    if difference is None:
        return cell(None)
    return f"{difference:.3f}" if difference >= _MS_SHOWN else f"below {_MS_SHOWN}"


def _certainty(job: ShownResult, mv_unit: str) -> Iterator[tuple[str, str, str]]:
    """Yields lines of the table on how certain the result of fast is: label, value, unit."""
    found, step = job.evidence, job.verification
    if job.tested_on_loop is False:
        yield "tested on the loop", "never", ""
    if found is not None:
        yield "uncertainty of Ms", _of_ms(found.uncertainty), "(2 std. dev.)"
        yield "Ms, other models", _of_ms(found.ambiguity), "(max. diff.)"
        if found.longest_delay_seen_s is not None:
            yield "second path seen up to", cell(found.longest_delay_seen_s), "s later (30 % of the effect)"
        for load in found.loads:
            yield "load disturbance", f"{load.size:+.4g} at {load.t_s:.4g}", f"{mv_unit}, s into the test"
    if step is not None:
        yield "fit of measured step", f"{step.fit_pct:.1f}", "%"
