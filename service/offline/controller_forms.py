"""Gains as a controller's faceplate asks for them: the form of the law, proportional band, minutes, repeats per minute.

The gains are dimensionless (per cent of the MV span per per cent of the PV span) where the span of PV is given, else
in MV units per PV unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from loopwright.tuning.gains import Gains, to_parallel, to_series
from loopwright.tuning.reasons import Refused


class ControllerForm(StrEnum):
    """The forms of the controller that faceplates have."""

    ISA = "isa"
    PARALLEL = "parallel"
    SERIES = "series"
    PB = "pb"
    REPEATS = "repeats"


EQUATIONS = {
    ControllerForm.ISA: "Kp (1 + 1/(Ti s) + Td s)",
    ControllerForm.PARALLEL: "Kp + Ki/s + Kd s",
    ControllerForm.SERIES: "Kp (1 + 1/(Ti s)) (1 + Td s)",
    ControllerForm.PB: "100/PB (1 + 1/(Ti s) + Td s)",
    ControllerForm.REPEATS: "Kp (1 + Ri/s + Td s), Ri in repeats per minute",
}
VENDORS = {
    ControllerForm.ISA: "DeltaV (form Standard), Siemens S7 CONT_C, Rockwell PIDE (dependent, --minutes)",
    ControllerForm.PARALLEL: "Rockwell PIDE (independent gains), GE Fanuc 90",
    ControllerForm.SERIES: "DeltaV (form Series), Honeywell TDC 3000 (--minutes)",
    ControllerForm.PB: "Yokogawa CENTUM, Foxboro I/A (PI, --minutes)",
    ControllerForm.REPEATS: "Bailey Infi 90, Modicon",
}
"""Where the form is found; a block's own manual decides."""


class BadForm(ValueError):
    """The form cannot be shown with what is given."""


@dataclass(frozen=True, slots=True)
class Faceplate:
    """What a faceplate asks for.

    form: the form of the law.
    pv_span: the span of PV, PV units, or None for gains in MV units per PV unit.
    mv_span: the span of MV, MV units.
    minutes: whether times are in minutes.
    """

    form: ControllerForm = ControllerForm.ISA
    pv_span: float | None = None
    mv_span: float = 100.0
    minutes: bool = False

    def __post_init__(self) -> None:
        """Raises BadForm."""
        if self.pv_span is not None and not 0.0 < self.pv_span < float("inf"):
            raise BadForm(f"--pv-span is the span of PV in PV units, greater than 0, not {self.pv_span:g}")
        if not 0.0 < self.mv_span < float("inf"):
            raise BadForm(f"--mv-span is the span of MV in MV units, greater than 0, not {self.mv_span:g}")
        if self.form is ControllerForm.PB and self.pv_span is None:
            raise BadForm("a proportional band is a part of the span of PV: give --pv-span, such as 200 for 0..200")

    @property
    def columns(self) -> tuple[tuple[str, str], ...]:
        """The name and the unit of each of the three numbers."""
        time = "min" if self.minutes else "s"
        gain = "MV/PV" if self.pv_span is None else "%/%"
        match self.form:
            case ControllerForm.PARALLEL:
                return ("Kp", gain), ("Ki", f"{gain}/{time}"), ("Kd", f"{gain} {time}")
            case ControllerForm.PB:
                return ("PB", "%"), ("Ti", time), ("Td", time)
            case ControllerForm.REPEATS:
                return ("Kp", gain), ("Ri", "1/min"), ("Td", time)
        return ("Kp", gain), ("Ti", time), ("Td", time)

    def numbers(self, gains: Gains) -> tuple[float, float, float] | None:
        """Returns the three numbers of gains in ISA form; None where the form has none (the series form of Ti < 4 Td).

        Ti is 0 for no integral action, as in the ISA form.
        """
        per, scale = 60.0 if self.minutes else 1.0, 1.0 if self.pv_span is None else self.pv_span / self.mv_span
        Kp, Ti, Td = gains.Kp * scale, gains.Ti / per, gains.Td / per
        match self.form:
            case ControllerForm.PARALLEL:
                parallel = to_parallel(gains)
                return parallel.Kp * scale, parallel.Ki * scale * per, parallel.Kd * scale / per
            case ControllerForm.SERIES:
                try:
                    series = to_series(gains)
                except Refused:
                    return None
                return series.Kp * scale, series.Ti / per, series.Td / per
            case ControllerForm.PB:
                return 100.0 / Kp, Ti, Td
            case ControllerForm.REPEATS:
                return Kp, 60.0 / gains.Ti if gains.Ti > 0.0 else 0.0, Td
        return Kp, Ti, Td


ISA_IN_S = Faceplate()
"""The form used inside Loopwright."""
