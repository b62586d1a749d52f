"""The parts that the plant and controller processes share: bus, signals, the "ready" line and the configuration
file."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import yaml

from loopwright.protocol.bus import Bus, BusError
from loopwright.protocol.device_runtime import Runtime
from loopwright.protocol.profile import MAX_CHANNELS, node_name
from loopwright.protocol.rejoined_bus import open_device_bus


class DeviceConfigError(Exception):
    """Raised when the configuration file or the options are not valid; the text says where."""


class DeviceProcess(Protocol):
    """A device that `run_device` can start: it has a runtime."""

    runtime: Runtime

    def start(self) -> None: ...


def node_id(text: str) -> int:
    """Parses a node-ID, 1..127, written in decimal or as 0x..; raises argparse.ArgumentTypeError."""
    node = int(text, 0)
    if not 1 <= node <= 127:
        raise argparse.ArgumentTypeError("a node-ID is 1..127")
    return node


def sample_time(text: str) -> float:
    """Parses a sample time, 0.0001..3600 s; raises argparse.ArgumentTypeError."""
    value = float(text)
    if not 0.0001 <= value <= 3600.0:
        raise argparse.ArgumentTypeError("a sample time is 0.0001 to 3600 s")
    return value


def check_nodes(controller: int, plant: int) -> None:
    """Raises DeviceConfigError where two devices on one bus would have one node-ID."""
    if controller == plant:
        raise DeviceConfigError(f"the controller and its plant have the node-ID {node_name(plant)} both")


def check_count(channels: Sequence[object]) -> None:
    """Raises DeviceConfigError for more channels than there are COB-IDs for, or none."""
    if not 1 <= len(channels) <= MAX_CHANNELS:
        raise DeviceConfigError(f"a device has 1 to {MAX_CHANNELS} channels, not {len(channels)}")


def read_channels(path: str, keys: Iterable[str]) -> list[dict[str, Any]]:
    """Reads the list of channels of a YAML file; an unknown key is refused rather than ignored.

    Raises DeviceConfigError.
    """
    try:
        rows = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DeviceConfigError(f"{path}: {error}") from error
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise DeviceConfigError(f"{path}: a list of channels is expected")
    known = set(keys)
    for number, row in enumerate(rows, start=1):
        for key in row:
            if key not in known:
                raise DeviceConfigError(
                    f"{path}: channel {number}: {key!r} is unknown; there are {', '.join(sorted(known))}"
                )
    return rows


def run_device(name: str, bus_url: str, make: Callable[[Bus], DeviceProcess], description: str) -> int:
    """Runs a device until SIGTERM or SIGINT. Returns exit status 0, or 1 when the bus cannot be used."""
    try:
        bus = open_device_bus(bus_url)
    except BusError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    try:
        device = make(bus)

        def end(number: int, frame: FrameType | None) -> None:
            device.runtime.stop()

        signal.signal(signal.SIGTERM, end)
        signal.signal(signal.SIGINT, end)
        device.start()
        print(f"ready {name} {description}", flush=True)
        device.runtime.run()
    except BusError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    finally:
        bus.close()
    return 0
