"""Whether a file shows a loop in automatic, and what to say of it: who takes it for a test is asked, never misled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.service.offline.csv_record.record import Record
from loopwright.tuning.analysis.sticking import find_sticking
from loopwright.tuning.identification.identify import SURELY_WHITE, Identified
from loopwright.tuning.identification.problem import NEGLIGIBLE_RMS
from loopwright.tuning.identification.record import sample_time
from loopwright.tuning.models import FOPDT, SOPDT, Integrating
from loopwright.tuning.operation.recorded_control import RecordedControl, recorded_control

GIVE = "Kp in MV per PV, ISA form, Ti in s; --td and --b where they are in effect"
SAME_WEIGHT = 0.02
"""Distance from 1 within which a set-point weight is not named."""


@dataclass(frozen=True, slots=True)
class InAutomatic:
    """What a file of a loop in automatic shows of its controller, in words.

    control: the controller.
    why: why the loop is taken to have been in automatic, a sentence.
    options: the options that `identify` needs in addition; those in capitals have to be filled in. None: no options
    help, as the record tells nothing of the plant.
    """

    control: RecordedControl
    why: str
    options: tuple[str, ...] | None

    @property
    def tells_nothing(self) -> bool:
        """Whether nothing but loads and noise can have moved PV, as SP rests."""
        return self.control.certain and self.options is None

    @property
    def law(self) -> str:
        """The gains that MV follows by, " by Kp 1.2, Ti 9 s"; "" where they do not show."""
        gains = self.control.gains
        if gains is None:
            return ""
        named = f"Kp {gains.Kp:.3g}, Ti {gains.Ti:.3g} s"
        if (least := self.control.weight_minimum) is not None:
            named += f", b {least:.2g} or more (OP was at its limit where SP moved)"
        else:
            named += f", b {gains.b:.2g}" if abs(gains.b - 1.0) > SAME_WEIGHT else ""
        return f" by {named}"


def in_automatic(record: Record) -> InAutomatic | None:
    """What the record shows of a controller; None where MV was moved by hand, by a relay or by a sequence."""
    control = recorded_control(sample_time(record.t), record.u, record.y, record.sp) if len(record.t) > 1 else None
    if control is None:
        return None
    found = InAutomatic(control, "", _options(record, control))
    return InAutomatic(control, _why(record, found), found.options)


def identified_as_it_is(found: Identified, automatic: InAutomatic) -> bool:
    """Whether a model of a record in automatic may be trusted although nothing is known of the controller.

    A fit from MV to PV is not biased by the controller where all that moves PV besides MV is white noise. So the
    residual must be white, and a model of at most two lags must do: more freedom can make the trace of a load white.
    """
    if automatic.tells_nothing:
        return False
    lags = isinstance(found.model, FOPDT | SOPDT | Integrating)
    little = found.noise_std < NEGLIGIBLE_RMS * float(np.ptp(found.y))
    return found.explained and lags and (found.whiteness > SURELY_WHITE or little)


def _why(record: Record, found: InAutomatic) -> str:
    control = found.control
    if not control.certain:
        return "MV has many values, as the output of a controller has"
    if not control.setpoint_moves:
        rests = record.without_setpoint if record.sp is None else "SP rests"
        text = f"MV follows PV, as in automatic, and {rests}"
        sticking = find_sticking(sample_time(record.t), np.asarray(record.u), np.asarray(record.y))
        return text if sticking is None else f"{text}; {sticking.in_words}"
    times = "once" if control.setpoint_moves == 1 else f"{control.setpoint_moves} times"
    if found.law:
        follows = f"MV follows SP and PV{found.law} ({100.0 * control.part:.4g} % of its moves)"
    else:
        follows = "MV answers PV"
    return f"SP moves {times} and {follows}, as in automatic"


def _options(record: Record, control: RecordedControl) -> tuple[str, ...] | None:
    if record.sp is None:
        return ("--sp", "COLUMN", "--kp", "KP", "--ti", "TI")
    if not control.setpoint_moves:
        return None
    gains = control.gains
    if gains is None:
        return ("--kp", "KP", "--ti", "TI")
    options = ["--kp", f"{gains.Kp:.3g}", "--ti", f"{gains.Ti:.3g}"]
    known = control.weight_minimum is None
    options += ["--b", f"{gains.b:.2g}" if known else "B"] if not known or abs(gains.b - 1.0) > SAME_WEIGHT else []
    return tuple(options)
