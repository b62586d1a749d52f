"""What is known of a plant from operation, as bytes for the store: a compressed JSON object."""

from __future__ import annotations

import zlib

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from loopwright.service.results import GainsView
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.fast.record import Excitation, ExperimentRecord

UNREADABLE = NothingKnown("what was known of the loop as the job began cannot be read again")


class PackedPlant(BaseModel):
    """The fields of `ObservedPlant` and of its record. why: the reason why nothing is known; the rest is then empty."""

    model_config = ConfigDict(extra="forbid")

    why: str | None = None
    Ts: float = 0.0
    u: list[float] = []
    y: list[float] = []
    direction: float = 0.0
    turns: int = 0
    period: float = 0.0
    lengths: list[int] = []
    u_earlier: list[list[float]] = []
    held_s: float | None = None
    together: int = 0
    gains: GainsView | None = None
    pv: tuple[float, float] = (0.0, 0.0)
    mv: tuple[float, float] = (0.0, 0.0)
    age_s: float = 0.0
    source: str = ""


def pack(known: ObservedPlant | NothingKnown) -> bytes:
    """What is known as bytes."""
    if isinstance(known, NothingKnown):
        packed = PackedPlant(why=known.why)
    else:
        record = known.record
        packed = PackedPlant(
            Ts=record.Ts,
            u=record.u.tolist(),
            y=record.y.tolist(),
            direction=record.direction,
            turns=record.turns,
            period=record.period,
            lengths=list(record.lengths),
            u_earlier=[each.tolist() for each in record.u_earlier],
            held_s=record.held_s,
            together=known.together,
            gains=GainsView.of(known.gains),
            pv=known.pv,
            mv=known.mv,
            age_s=known.age_s,
            source=known.source,
        )
    return zlib.compress(packed.model_dump_json().encode())


def unpack(data: bytes) -> ObservedPlant | NothingKnown:
    """What is known, from these bytes."""
    try:
        packed = PackedPlant.model_validate_json(zlib.decompress(data))
    except (zlib.error, ValidationError):
        return UNREADABLE
    if packed.why is not None or packed.gains is None:
        return NothingKnown(packed.why or UNREADABLE.why)
    record = ExperimentRecord(
        Ts=packed.Ts,
        u=np.array(packed.u),
        y=np.array(packed.y),
        direction=packed.direction,
        listened=packed.lengths[0],
        excited=sum(packed.lengths),
        turns=packed.turns,
        period=packed.period,
        excitation=Excitation.OBSERVE,
        lengths=tuple(packed.lengths),
        u_earlier=tuple(map(np.array, packed.u_earlier)),
        held_s=packed.held_s,
    )
    gains = packed.gains.gains()
    return ObservedPlant(record, packed.together, gains, packed.pv, packed.mv, packed.age_s, packed.source)
