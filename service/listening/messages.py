"""What the service and the process that listens tell each other."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from loopwright.protocol.profile import ChannelIds
from loopwright.service.listening.bins import Bins, Rows
from loopwright.service.listening.heard_loop import Heard, InEffect
from loopwright.service.listening.heard_node import HeardHeartbeat


@dataclass(frozen=True)
class Listen:
    """The first message: the loops to listen to, by bus and tag, and the nodes, by bus."""

    loops: Mapping[str, Mapping[str, ChannelIds]]
    nodes: Mapping[str, Collection[int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Query:
    """A question for the history of a loop, as `Rings.rows`."""

    number: int
    tag: str
    from_s: float
    to_s: float
    points: int


@dataclass(frozen=True)
class Learn:
    """A reading of a loop."""

    tag: str
    found: InEffect


@dataclass(frozen=True)
class Watch:
    """Asks for the new samples of these loops, as they come, instead of those asked for before."""

    tags: frozenset[str]


@dataclass(frozen=True)
class Finish:
    """Asks for all that is not stored yet, and for the end."""


@dataclass(frozen=True)
class HistoryAnswer:
    """The answer to a question.

    oldest_s: time of the oldest row in memory, s; infinite where there is none.
    silent_from_s: time of the last sample where further ones are due, s; infinite while they come.
    """

    number: int
    rows: Rows
    oldest_s: float
    silent_from_s: float


@dataclass(frozen=True)
class FinishedBlock:
    """Finished bins of a loop, to be stored: `bins.packed`.

    after_s: time of the last sample of the block before; None for the first block.
    """

    tag: str
    after_s: float | None
    first_s: float
    last_s: float
    count: int
    data: bytes


@dataclass(frozen=True)
class NewSamples:
    """The new samples of the loops that are watched, by tag: rows of `bins.SAMPLE`."""

    samples: Mapping[str, Bins]


@dataclass(frozen=True)
class Report:
    """What there is to tell, once a second.

    down: buses that are not heard, with the reason.
    frames: number of frames since the last report, by bus.
    to_read: loops whose set-point, mode and gains are to be read.
    finished: whether this is the last report.
    heard: what was heard last, by tag; without the loops of which nothing was heard.
    nodes: the heartbeats heard last, by bus and node; without the nodes of which none was heard.
    """

    down: Mapping[str, str]
    frames: Mapping[str, int]
    to_read: Sequence[str] = ()
    blocks: Sequence[FinishedBlock] = field(default=())
    finished: bool = False
    heard: Mapping[str, Heard] = field(default_factory=dict)
    nodes: Mapping[tuple[str, int], HeardHeartbeat] = field(default_factory=dict)
