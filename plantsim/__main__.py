"""The plant process: python -m loopwright.plantsim --bus socketcan:vcan0 --model model-4 --ts 0.1 --speed max"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from loopwright.plantsim.catalogue import find
from loopwright.plantsim.device import PlantChannel, PlantDevice
from loopwright.plantsim.own_plant import own_plant
from loopwright.protocol.device_process import (
    DeviceConfigError,
    check_count,
    check_nodes,
    node_id,
    read_channels,
    run_device,
    sample_time,
)
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE
from loopwright.protocol.real32 import fits


def main(argv: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(argv)
    try:
        rows = read_channels(options.config, ("model", "noise")) if options.config else []
        rows += [{"model": name} for name in options.model]
        channels = [_channel(row.get("model", ""), float(row.get("noise", options.noise))) for row in rows]
        if not channels:
            raise DeviceConfigError("no plant given; use --model NAME or --config FILE")
        check_count(channels)
        check_nodes(options.controller_node, options.node)
        for channel in channels:
            channel.build(options.ts, channel.noise_std, options.seed)
    except (DeviceConfigError, KeyError, TypeError, ValueError) as error:
        print(f"plantsim: {error.args[0]}", file=sys.stderr)
        return 2
    if options.speed == 0.0:
        os.nice(10)  # at full speed the process would starve others on its processor
    return run_device(
        "plantsim",
        options.bus,
        lambda bus: PlantDevice(
            bus,
            channels,
            options.ts,
            options.speed,
            seed=options.seed,
            node=options.node,
            controller_node=options.controller_node,
        ),
        f"node {options.node:#04x} on {options.bus}: {len(channels)} channel(s), Ts {options.ts:g} s",
    )


def _channel(model: object, noise_std: float) -> PlantChannel:
    if not isinstance(model, str):
        raise DeviceConfigError(f"model is {model!r}: it is a name, or a JSON object in quotation marks")
    if not (fits(noise_std) and noise_std >= 0.0):
        raise DeviceConfigError(f"noise is {noise_std:g}: a standard deviation is finite and not negative")
    entry = own_plant(model) if model.lstrip().startswith("{") else find(model)
    return PlantChannel(entry.build, entry.facts.mv_nominal_pct, noise_std)


def _speed(text: str) -> float:
    """Returns the value of the pace object; 0 stands for "max"."""
    if text == "max":
        return 0.0
    factor = float(text)
    if not 0.0 < factor <= 1e6:
        raise argparse.ArgumentTypeError("max, or a factor above 0")
    return factor


def _seed(text: str) -> int:
    value = int(text)
    if not 0 <= value <= 0xFFFFFFFF:
        raise argparse.ArgumentTypeError("a seed is 0 to 4294967295")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="plantsim", description="A simulated plant as a CANopen I/O device.")
    parser.add_argument("--bus", required=True, metavar="URL", help="socketcan:vcan0, socketcand:HOST:PORT, ...")
    parser.add_argument(
        "--model",
        action="append",
        default=[],
        metavar="MODEL",
        help="one channel each: a name such as model-4, or the plant itself as JSON, "
        '{"num": [0.8], "den": [120, 1], "dead_time_s": 15, "mv": 40, "pv": 65}, in PV units per percent of MV, with '
        'MV and PV where it starts; with "second_path": {"share": 0.4, "later_s": 180} MV acts again, with "valve": '
        '{"backlash_pct": 1} (or stiction_pct, equal_percentage, gain_below) its valve is no straight line, with '
        '"sine": {"amplitude": 0.2, "period_s": 30} PV swings; `loopwright plant` takes K, T_s, L_s and a file.json '
        "too",
    )
    parser.add_argument("--config", metavar="FILE", help="YAML list of channels: model, noise")
    parser.add_argument("--ts", type=sample_time, default=0.1, metavar="S", help="sample time, process seconds")
    parser.add_argument("--speed", type=_speed, default=1.0, metavar="FACTOR", help="times real time, or max")
    parser.add_argument("--noise", type=float, default=0.0, metavar="STD", help="measurement noise, PV units")
    parser.add_argument("--seed", type=_seed, default=1)
    parser.add_argument("--node", type=node_id, default=PLANT_NODE)
    parser.add_argument("--controller-node", type=node_id, default=CONTROLLER_NODE)
    return parser


if __name__ == "__main__":
    sys.exit(main())
