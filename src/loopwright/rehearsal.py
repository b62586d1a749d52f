"""A retune rehearsed in memory, on a plant of your own or on a model; needs numpy, scipy and pydantic.

    from loopwright import rehearsal

    found = rehearsal.retune(Tank(), sample_time_s=1.0, t95_s=200.0)      # Tank has step(mv), which returns PV
    print(found)                                    # gains, or why there are none
    found.record.t, found.record.pv                 # arrays; a notebook shows the record by itself

retune      a procedure ("fast", "setpoint", "five-stage") on any object with step(mv)
rehearse    the same on a model: {"K": 2, "T_s": 10, "L_s": 3}, or the content of a plant file
Rehearsal   the answer: gains, model, ended (why there are none), result (every figure), record (t, sp, pv, mv, stages)

The controller, the procedures and the runner are those of the service, and time is counted in samples.
"""

from loopwright.service.execution.own_plant import HasStep, retune
from loopwright.service.execution.rehearsal import rehearse
from loopwright.service.execution.rehearsed import Rehearsal, RehearsalRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Refused

__all__ = ["Gains", "HasStep", "Refused", "Rehearsal", "RehearsalRecord", "rehearse", "retune"]
