"""The reasons why a job did not end with a proposal: a closed list, each with advice for the person who can act on it.

    Refused   the loop or the data does not allow a trustworthy result; nothing is broken
    Failed    something broke or ran out on the way (a node, the bus, time)
    Aborted   someone asked for it to stop
    NoGain    the loop is tuned as well as asked already: a good end

The runner leaves the loop as it was after each of the four.
"""

from __future__ import annotations

from enum import StrEnum


class Reason(StrEnum):
    """The closed list of reasons. The API shows the value; `ADVICE` says what to do."""

    # refused
    NOT_AT_REST = "not_at_rest"
    NOISE_TOO_HIGH = "noise_too_high"
    SATURATED = "saturated"
    WRONG_MODE = "wrong_mode"
    LOOP_IN_USE = "loop_in_use"
    SETPOINT_IS_DRIVEN = "setpoint_is_driven"
    WRONG_SIGN = "wrong_sign"
    NO_RESPONSE = "no_response"
    CANNOT_OSCILLATE = "cannot_oscillate"
    SAMPLING_TOO_SLOW = "sampling_too_slow"
    NO_BRACKET = "no_bracket"
    NO_OVERSHOOT = "no_overshoot"
    NOT_SELF_REGULATING = "not_self_regulating"
    NOT_ROBUST = "not_robust"
    NOT_POSSIBLE = "not_possible"
    NOT_CONFIRMED = "not_confirmed"
    BAD_LIMITS = "bad_limits"
    BAD_INPUT = "bad_input"
    OUTSIDE_RANGE = "outside_range"
    DEVICE_MISMATCH = "device_mismatch"
    MV_LIMIT = "mv_limit"
    STALLED = "stalled"
    UNEXPLAINED = "unexplained"
    PV_ALTERED = "pv_altered"
    MV_ALTERED = "mv_altered"
    DISTURBED = "disturbed"
    UNCERTAIN = "uncertain"
    AMBIGUOUS = "ambiguous"
    MODEL_MISMATCH = "model_mismatch"
    CONTROLLER_MISMATCH = "controller_mismatch"
    DIVERGES = "diverges"
    LOCKED = "locked"
    NOT_ACKNOWLEDGED = "not_acknowledged"
    # no gain
    NO_GAIN = "no_gain"
    # failed
    PV_LIMIT = "pv_limit"
    TIME_BUDGET = "time_budget"
    BAD_SAMPLE = "bad_sample"
    SAMPLES_LOST = "samples_lost"
    PV_FROZEN = "pv_frozen"
    NODE_LOST = "node_lost"
    NODE_NOT_ANSWERING = "node_not_answering"
    BUS_LOST = "bus_lost"
    GATEWAY_LOST = "gateway_lost"
    NODE_NOT_OPERATIONAL = "node_not_operational"
    SESSION_ENDED_BY_DEVICE = "session_ended_by_device"
    RESTORE_UNCONFIRMED = "restore_unconfirmed"
    COMPUTATION_LIMIT = "computation_limit"
    COMPUTATION_LOST = "computation_lost"
    INTERNAL = "internal"
    # aborted: by another's hand on the loop, on request, or with the service
    SETPOINT_CHANGED = "setpoint_changed"
    MODE_CHANGED = "mode_changed"
    GAINS_CHANGED = "gains_changed"
    OUTPUT_CHANGED = "output_changed"
    LIMITS_CHANGED = "limits_changed"
    OPERATOR = "operator"
    SERVICE_STOPPED = "service_stopped"


ADVICE: dict[Reason, str] = {
    Reason.NOT_AT_REST: "Wait until PV and MV are steady (or put the loop in manual and let it settle), then retune. "
    "A loop that cycles because its valve sticks does not settle: see to the valve first.",
    Reason.NOISE_TOO_HIGH: "Filter the measurement or permit a larger set-point deviation.",
    Reason.SATURATED: "MV is at a limit: move the operating point or widen the limits, then retune.",
    Reason.WRONG_MODE: "Put the loop in automatic with working gains, or permit pulses of the manual output "
    "(loops.yaml), then retune.",
    Reason.LOOP_IN_USE: "Another tuner holds a session on this loop: wait for its end, then retune.",
    Reason.SETPOINT_IS_DRIVEN: "Another controller or a ramp moves the set-point: put the loop to local set-point, or "
    "wait for the ramp's end, then retune.",
    Reason.WRONG_SIGN: "Check the controller's action (direct/reverse) against the sign of the plant's gain.",
    Reason.NO_RESPONSE: "PV did not answer MV: check the valve, the sensor and that the right loop is selected.",
    Reason.CANNOT_OSCILLATE: "The plant has next to no dead time, or the sampling is too slow to see it "
    "(22 samples a period at least): sample faster, or use a model-based rule. Or T95 is stated far too short: state "
    "it longer.",
    Reason.SAMPLING_TOO_SLOW: "Choose a sample time of at most a fiftieth of the ultimate period.",
    Reason.NO_BRACKET: "The ultimate gain was not found within a factor 8 of the relay's estimate; "
    "check for backlash, sticking or another loop acting on this one.",
    Reason.NO_OVERSHOOT: "The overshoot never came into the window: the plant is outside the class of this procedure; "
    "enter a model by hand or use another method.",
    Reason.NOT_SELF_REGULATING: "The plant integrates: use a rule for integrating plants; where the loop is in manual, "
    "put it in automatic, then retune.",
    Reason.NOT_ROBUST: "The best PI would not be robust; keep the present gains, or enter a model by hand.",
    Reason.NOT_POSSIBLE: "Ask for what the message says is possible, or leave that requirement out; nothing else is "
    "wrong with the loop.",
    Reason.NOT_CONFIRMED: "The loop did not behave as its model predicts: keep the present gains, and repeat.",
    Reason.BAD_LIMITS: "Correct the limits: low < present value < high, and enough room for the test on both sides.",
    Reason.BAD_INPUT: "Correct the value named in the message.",
    Reason.OUTSIDE_RANGE: "The method is not made for this plant or value: choose another method, or what the message "
    "says would be accepted.",
    Reason.DEVICE_MISMATCH: "The device is not the one the configuration describes; check node ids and firmware.",
    Reason.MV_LIMIT: "MV reached its limit during the test: permit more MV or a smaller set-point deviation.",
    Reason.STALLED: "The test did not go on: a load about as large as what the test moves holds PV. Wait until it is "
    "over, or permit more MV.",
    Reason.UNEXPLAINED: "No linear model explains the record: look for a sticking valve, a limit, lags that "
    "differ for rising and falling, a gain that changes with MV (linearise the valve's characteristic, or permit less "
    "MV), another loop or several changes of the load, "
    "then retune.",
    Reason.PV_ALTERED: "PV reaches the controller otherwise than the plant gives it: have the sensor, or what passes "
    "its value on, renew it at every sample, finely and without wrong samples, or choose a sample time as long as its "
    "interval, then retune.",
    Reason.MV_ALTERED: "The plant gets another MV than the controller gives: choose a window that is short beside the "
    "plant's dead time, a faster or finer actuator, or permit only as much MV as it follows, then retune.",
    Reason.DISTURBED: "Something slow moved PV during the test: wait for a steady time, then retune.",
    Reason.UNCERTAIN: "The record does not tell enough for this robustness: permit more MV, filter the measurement, or "
    "ask for a lower Ms.",
    Reason.AMBIGUOUS: "Several models explain the record and disagree: permit more MV, or retune in a steady time.",
    Reason.MODEL_MISMATCH: "The loop behaved differently under the new gains than before: look for changes of "
    "the load or of the plant, then retune.",
    Reason.CONTROLLER_MISMATCH: "The controller does not do what its gains say: correct in its settings, or in the "
    "gains that are stored for it, what the message names, then retune.",
    Reason.DIVERGES: "PV ran away under the new gains, which were taken back: keep the present gains, and repeat.",
    Reason.LOCKED: "Somebody has locked the loop: ask them, or unlock it on its page (or by loopwright unlock TAG), "
    "then ask again.",
    Reason.NOT_ACKNOWLEDGED: "The last test found PV to be false, and nobody has acknowledged that: check the sensor, "
    "acknowledge the alarm (or loopwright acknowledge TAG), then ask again.",
    Reason.NO_GAIN: "The loop is already tuned as well as asked: nothing needs to be done. For a faster or a more "
    "robust loop ask for another Ms, for a proposal all the same set propose_anyway.",
    Reason.PV_LIMIT: "PV reached its limit: permit less MV deviation, or widen the PV limits if it is safe.",
    Reason.TIME_BUDGET: "The test took longer than its budget: check T95, or raise the budget.",
    Reason.BAD_SAMPLE: "PV was not a finite number, or another one than the plant can give: check the sensor and its "
    "scaling. Where the message says that PV is false, see that the loop is in manual, and control it by hand; when PV "
    "is right again, acknowledge the alarm (or loopwright acknowledge TAG), put the loop in automatic, then retune.",
    Reason.SAMPLES_LOST: "Samples were lost on the way: check bus load, or run a simulated plant more slowly.",
    Reason.PV_FROZEN: "PV stood still, or had another noise, as the plant cannot: check the sensor, see that the loop "
    "is in manual (the message says what it was left in), and control it by hand; when PV is right again, acknowledge "
    "the alarm (or loopwright acknowledge TAG), put the loop in automatic, then retune.",
    Reason.SETPOINT_CHANGED: "Somebody else moved the set-point during the test; agree on the time and repeat.",
    Reason.MODE_CHANGED: "Somebody else changed the mode during the test; agree on the time and repeat.",
    Reason.GAINS_CHANGED: "Somebody else tried other gains during the test; agree on the time and repeat.",
    Reason.NODE_LOST: "The device sends no data: check power and cable; it restores the loop by itself.",
    Reason.NODE_NOT_ANSWERING: "The device sends heartbeats and answers no request, so it has power and a cable: see "
    "whether its SDO server hangs or is kept busy by another master, or the bus loses frames; start its program anew "
    "when the loop permits. It restores the loop by itself.",
    Reason.BUS_LOST: "Check the CAN interface, its name and whether it is up; the device restores the loop by itself.",
    Reason.GATEWAY_LOST: "The gateway of the loop alone reaches it: see that its service runs and reaches the "
    "database. What is under test there goes on, or ends safely by itself.",
    Reason.NODE_NOT_OPERATIONAL: "The node does not control: start it (NMT) and look at the loop; Loopwright looks at "
    "it again by itself, and sends no NMT command.",
    Reason.SESSION_ENDED_BY_DEVICE: "The controller ended the test by itself (lease, heartbeat): check the load of "
    "this machine.",
    Reason.RESTORE_UNCONFIRMED: "The loop could not be read back after the test: look at the controller NOW.",
    Reason.COMPUTATION_LIMIT: "Look for a number in the model or the options that is far from any plant's (gain, time "
    "constants, dead time against T95 and sample time), or have an administrator permit more by the option of "
    "`loopwright serve` named.",
    Reason.COMPUTATION_LOST: "The system ended the computation, or had no room for it: see that the machine has memory "
    "left, then repeat.",
    Reason.INTERNAL: "This is a defect of Loopwright; please report it with the job's events.",
    Reason.OUTPUT_CHANGED: "Somebody else moved the manual output during the test; agree on the time and repeat.",
    Reason.LIMITS_CHANGED: "Somebody else changed a limit, the span or the action during the test; agree on the time "
    "and repeat.",
    Reason.OPERATOR: "Stopped on request.",
    Reason.SERVICE_STOPPED: "The service was stopped during the test; start the retune again.",
}


class Ended(Exception):
    """A plan or its runner ended early.

    reason: the reason from the closed list.
    detail: a sentence with the numbers.
    """

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(f"{reason.value}: {detail}")
        self.reason = reason
        self.detail = detail

    def __reduce__(self) -> tuple[type[Ended], tuple[Reason, str]]:
        return type(self), (self.reason, self.detail)

    @property
    def advice(self) -> str:
        """What the person who can act on the reason should do."""
        return ADVICE[self.reason]


class Refused(Ended):
    """The loop or the data does not allow a trustworthy result; nothing is broken."""


class Failed(Ended):
    """Something broke or ran out on the way."""


class FalsePv(Failed):
    """PV is false within its limits: it stands still, or has jumped, as the plant cannot. The loop is not given back to
    automatic on such a PV."""


class NoGain(Ended):
    """Nothing that was asked for would improve, so the present gains are kept."""


class Aborted(Ended):
    """A person, or the shutdown of the service, has stopped the plan."""
