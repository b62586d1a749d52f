"""The controller process: python -m loopwright.controller --bus socketcan:vcan0 --kp 2 --ti 10 --sp 50"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from loopwright.controller.channel import Settings
from loopwright.controller.device import ControllerChannel, ControllerDevice
from loopwright.controller.pid import Parameters
from loopwright.controller.retained_state import RetainedStateError, RetainedStateFile, read_retained_state
from loopwright.protocol.device_process import (
    DeviceConfigError,
    check_count,
    check_nodes,
    node_id,
    read_channels,
    run_device,
    sample_time,
)
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, Mode

_MODES = {"off": Mode.OFF, "manual": Mode.MANUAL, "automatic": Mode.AUTOMATIC}
_NUMBERS = {
    "kp": (1.0, "percent of output per PV unit"),
    "ti": (0.0, "s; 0 = no integral action"),
    "td": (0.0, "s"),
    "tf": (0.0, "s"),
    "b": (1.0, "set point weight of P"),
    "c": (0.0, "set point weight of D"),
    "sp": (50.0, "set point, PV units"),
    "mv": (50.0, "first output, percent"),
    "mv_low": (0.0, "percent"),
    "mv_high": (100.0, "percent"),
    "pv_low": (0.0, "PV span; a PV farther outside than it is wide is no measurement, MV holds"),
    "pv_high": (100.0, "PV span"),
    "safe_output": (0.0, "percent, in mode off"),
    "rate_limit": (0.0, "percent per s, 0 = none"),
}


def main(argv: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(argv)
    common = {name: getattr(options, name) for name in (*_NUMBERS, "direct", "mode")}
    try:
        rows = read_channels(options.config, common) if options.config else [{}] * options.channels
        channels = [_channel({**common, **row}) for row in rows]
        check_count(channels)
        check_nodes(options.node, options.plant_node)
        if options.keep and not options.keep.parent.is_dir():
            raise DeviceConfigError(f"--keep {options.keep}: there is no folder {options.keep.parent}")
        retained = read_retained_state(options.keep, [one.retained for one in channels]) if options.keep else None
        if retained:
            channels = [one.with_retained(own) for one, own in zip(channels, retained, strict=True)]
        for one in channels:
            one.make(options.ts)
    except (DeviceConfigError, RetainedStateError, KeyError, TypeError, ValueError) as error:
        print(f"controller: {error.args[0]}", file=sys.stderr)
        return 2
    return run_device(
        "controller",
        options.bus,
        lambda bus: ControllerDevice(
            bus,
            channels,
            options.ts,
            options.node,
            options.plant_node,
            retained_state=RetainedStateFile(options.keep) if options.keep else None,
        ),
        f"node {options.node:#04x} on {options.bus}: {len(channels)} channel(s), Ts {options.ts:g} s"
        + (f", as stored in {options.keep}" if retained else ""),
    )


def _channel(row: Mapping[str, Any]) -> ControllerChannel:
    numbers = {name: float(row[name]) for name in _NUMBERS}
    mode = "off" if row["mode"] is False else row["mode"]  # to YAML the word off is the truth value false
    if mode not in _MODES:
        raise DeviceConfigError(f"mode {mode!r} is unknown; there are {', '.join(_MODES)}")
    if not isinstance(row["direct"], bool):  # any other word would count as true, and turn the action round
        raise DeviceConfigError(f"direct is {row['direct']!r}: it is true or false")
    return ControllerChannel(
        Parameters(*(numbers[name] for name in ("kp", "ti", "td", "tf", "b", "c"))),
        numbers["sp"],
        Settings(
            mv_low=numbers["mv_low"],
            mv_high=numbers["mv_high"],
            safe_output=numbers["safe_output"],
            rate_limit_per_s=numbers["rate_limit"],
            pv_low=numbers["pv_low"],
            pv_high=numbers["pv_high"],
            reverse=not row["direct"],
        ),
        _MODES[mode],
        numbers["mv"],
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="controller", description="A PI(D) controller as a CANopen device.")
    parser.add_argument("--bus", required=True, metavar="URL", help="socketcan:vcan0, socketcand:HOST:PORT, ...")
    parser.add_argument("--channels", type=int, default=1, metavar="N", help="that many, all alike")
    parser.add_argument("--config", metavar="FILE", help="YAML list of channels, with the names of these options (_)")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="keeps gains, mode, set-point over a restart")
    parser.add_argument("--ts", type=sample_time, default=0.1, metavar="S", help="sample time, process seconds")
    for name, (default, text) in _NUMBERS.items():
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, type=float, default=default, metavar="X", help=f"{text} (default {default:g})")
    parser.add_argument("--direct", action="store_true", help="MV rises as PV rises")
    parser.add_argument("--mode", choices=_MODES, default="automatic")
    parser.add_argument("--node", type=node_id, default=CONTROLLER_NODE)
    parser.add_argument("--plant-node", type=node_id, default=PLANT_NODE)
    return parser


if __name__ == "__main__":
    sys.exit(main())
