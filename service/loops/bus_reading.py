"""Readings of a loop over the bus: the identity and state of its controller and plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

from loopwright.protocol.objects import Device, default_of, lookup
from loopwright.protocol.profile import REVISION, Abort, NmtState, OnMissingAnswer, Order, node_name
from loopwright.protocol.session import GAINS, object_of
from loopwright.protocol.tuner import FailureKind, Tuner, TunerError
from loopwright.service.states.loop_state import OPERATIONAL, LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Failed, Reason, Refused

SILENT, NOT_ANSWERING = "silent", "beating, and answers no request"
_WHEN_SILENT: dict[int, str] = {
    OnMissingAnswer.HOLD_OUTPUT: "holds MV where it is",
    OnMissingAnswer.STOP_RUN: "stops its run, and MV stays",
    OnMissingAnswer.SAFE_OUTPUT: "goes to the safe output",
}


@dataclass(frozen=True, slots=True)
class BusReading:
    """Reads one channel.

    controller, plant: node-IDs; plant None for a plant that cannot be asked.
    Every method raises TunerError besides the errors that it names.
    """

    tuner: Tuner
    controller: int
    plant: int | None
    channel: int

    def identify(self) -> None:
        """Checks that both nodes are the expected devices. Raises Refused(DEVICE_MISMATCH),
        Failed(NODE_NOT_OPERATIONAL)."""
        self.identify_controller()
        if self.plant is not None:
            self._identify(self.plant, Device.PLANT)

    def identify_controller(self) -> None:
        self._identify(self.controller, Device.CONTROLLER)

    def _identify(self, node: int, device: Device) -> None:
        device_type = int(self.tuner.number("device_type", node=node))
        expected = int(default_of(lookup("device_type"), 0, device))
        if device_type != expected:
            other = Device.PLANT if device is Device.CONTROLLER else Device.CONTROLLER
            if device_type == int(default_of(lookup("device_type"), 0, other)):
                text = f"node {node_name(node)} is a {other.value}, not a {device.value}"
                swapped = "controller_node and plant_node seem to be swapped in loops.yaml"
                raise Refused(Reason.DEVICE_MISMATCH, f"{text}: {swapped}")
            text = f"node {node_name(node)} is of type {device_type:08X}h, not a {device.value} ({expected:08X}h)"
            raise Refused(Reason.DEVICE_MISMATCH, text)
        revision = int(self.tuner.number("identity", 3, node=node))
        if revision >> 16 != REVISION >> 16:
            raise Refused(
                Reason.DEVICE_MISMATCH,
                f"{device.value} node {node_name(node)} speaks revision {revision >> 16}.{revision & 0xFFFF} of the "
                f"profile, this service {REVISION >> 16}.{REVISION & 0xFFFF}: bring both to the same version",
            )
        self._check_operational(node)

    def check_knows(self, order: Order) -> None:
        """Checks that the controller knows an order that a test may need. Raises Refused(DEVICE_MISMATCH)."""
        try:
            self.tuner.read(object_of(order))
        except TunerError as error:  # an order can be written only: whatever else is answered, the object is there
            if error.code == Abort.NO_OBJECT:
                raise order_unknown(self.controller, order) from error
            if error.kind is not FailureKind.ABORT:
                raise

    def compare_times(self) -> None:
        """Compares the sample times: with another sample time than the plant's, the gains that a controller shows are
        not those that it applies. Raises Refused(DEVICE_MISMATCH)."""
        if self.plant is None:
            return
        controller_s, plant_s = (
            self.tuner.number("sample_time", node=node) / 1e6 for node in (self.controller, self.plant)
        )
        if controller_s != plant_s:
            text = f"controller node {node_name(self.controller)} has a sample time of {controller_s:g} s"
            raise Refused(Reason.DEVICE_MISMATCH, f"{text}, plant node {node_name(self.plant)} one of {plant_s:g} s")

    def check_controller_operational(self) -> None:
        """Raises Failed(NODE_NOT_OPERATIONAL) unless the controller is operational."""
        self._check_operational(self.controller)

    def check_plant_operational(self) -> None:
        """Raises Failed(NODE_NOT_OPERATIONAL) when the plant can be asked and is not operational."""
        if self.plant is not None:
            self._check_operational(self.plant)

    def _check_operational(self, node: int) -> None:
        state = int(self.tuner.number("node_state", node=node))
        if state != NmtState.OPERATIONAL:
            raise not_operational(node, state)

    def state(self) -> LoopState:
        """Returns the present state, with the accepted gains: a trial ends with these."""
        number = self.tuner.number
        plant_state, fail_action = self._plant_state()
        own = int(number("node_state", node=self.controller))
        away = [] if own == NmtState.OPERATIONAL else [f"node {node_name(self.controller)} is {state_name(own)}"]
        if plant_state != OPERATIONAL:
            away.append(self._plant_is(plant_state))
        return LoopState(
            mode=Mode(int(number("controller_mode"))),
            sp=number("controller_setpoint"),
            pv=number("controller_received_pv"),
            mv=number("controller_mv"),
            gains=self._gains("accepted"),
            on_trial=bool(number("controller_on_trial")),
            mv_low=number("controller_mv_low"),
            mv_high=number("controller_mv_high"),
            sample_time_s=number("sample_time", node=self.controller) / 1e6,
            reverse_acting=number("controller_action") == 0,
            manual_output=number("controller_manual_output"),
            node_state="; ".join(away) or OPERATIONAL,
            fail_action=fail_action,
        )

    def beside_the_test(self) -> LoopState:
        """Returns the present state, but while a session is open the state to which it returns."""
        return replace(
            self.state(),
            on_trial=False,
            mode=Mode(int(self.tuner.number("controller_home_mode"))),
            sp=self.tuner.number("controller_home_setpoint"),
            manual_output=self.tuner.number("controller_home_manual_output"),
            mv=self.tuner.number("controller_home_mv"),
        )

    def home(self) -> LoopState:
        """Returns the state before the test, with the gains that were accepted at the opening."""
        return replace(self.beside_the_test(), gains=self._gains("home"))

    def controls(self, state: LoopState) -> bool:
        """Returns whether the loop is controlled. A plant that is away does not prevent it; one that answers must be
        operational."""
        return state.node_state in (OPERATIONAL, self._plant_is(SILENT), self._plant_is(NOT_ANSWERING))

    def _gains(self, which: str) -> Gains:
        return Gains(*(self.tuner.number(f"controller_{which}_{name}") for name in GAINS))

    def _plant_is(self, state: str) -> str:
        return f"node {node_name(self.plant or 0)} is {state}"

    def _plant_state(self) -> tuple[str, str]:
        """Returns the plant's NMT state, and its action when the controller is silent. A plant that is away must not
        prevent a reading of the controller."""
        if self.plant is None:
            return OPERATIONAL, ""
        try:
            state = state_name(int(self.tuner.number("node_state", node=self.plant)))
            reaction = int(self.tuner.number("plant_on_missing_answer"))
            words = _WHEN_SILENT.get(reaction, "")
            if reaction == OnMissingAnswer.SAFE_OUTPUT:
                words += f" of {self.tuner.number('plant_safe_output', self.channel):.6g} %"
            return state, words
        except TunerError:
            return NOT_ANSWERING if self.tuner.beats(self.plant) else SILENT, ""


def order_unknown(node: int, order: Order) -> Refused:
    """Returns the error for a controller of an older version: the revision counts what was changed, not added."""
    return Refused(
        Reason.DEVICE_MISMATCH,
        f"controller node {node_name(node)} does not know the order {order.name} "
        f"(object {lookup(object_of(order)).index:04X}h): bring it to the version of this service",
    )


def not_operational(node: int, state: int) -> Failed:
    """Returns the error for a node that is not operational."""
    text = f"node {node_name(node)} is {state_name(state)}: it controls nothing, MV stays where it is"
    return Failed(Reason.NODE_NOT_OPERATIONAL, text)


def state_name(state: int) -> str:
    """Returns the name of an NMT state."""
    return NmtState(state).name.lower().replace("_", "-") if state in list(NmtState) else f"in NMT state {state}"
