"""What waits for a viewer is bounded, and comes once."""

from __future__ import annotations

import json

import numpy as np

from loopwright.service.listening.bins import SAMPLE, Bins, of_samples
from loopwright.service.live import viewer as module
from loopwright.service.live.messages import event
from loopwright.service.live.rows import samples_message
from loopwright.service.live.viewer import Viewer

T0 = 1_769_860_800.0


def batch(*numbers: int) -> Bins:
    rows = np.zeros(len(numbers), SAMPLE)
    rows["n"] = numbers
    rows["at_s"] = [T0 + n for n in numbers]
    return of_samples(rows)


def add(viewer: Viewer, *numbers: int) -> None:
    bins = batch(*numbers)
    viewer.add_samples("A", bins, event("samples", samples_message("A", bins, past=False)))


def taken(viewer: Viewer) -> list[int]:
    texts = [text.partition("data: ")[2] for text in viewer.take()]
    return [n for text in texts for n in json.loads(text)["n"]]


def test_a_message_takes_the_place_of_the_one_before() -> None:
    viewer = Viewer(frozenset(), {})
    for text in ("1", "2", "3"):
        viewer.show("loops", text)
    viewer.show("buses", "4")
    assert viewer.take() == ["3", "4"] and viewer.take() == []


def test_samples_that_the_viewer_has_are_left_out_once() -> None:
    viewer = Viewer(frozenset({"A"}), {})
    add(viewer, 1, 2)
    add(viewer, 3, 4)
    viewer.has_until("A", T0 + 3)
    assert taken(viewer) == [4]
    viewer.has_until("A", T0 + 9)
    for numbers in ((8, 9), (9, 10, 11), (12,), (2, 3)):
        add(viewer, *numbers)
    assert taken(viewer) == [10, 11, 12, 2, 3], "a plant or a clock that began anew is not left out"


def test_a_viewer_that_takes_nothing_holds_no_memory() -> None:
    viewer = Viewer(frozenset({"A"}), {})
    waiting = 0
    while not viewer.slow:
        add(viewer, *range(100))
        waiting += 1
    assert 10 < waiting < module.MOST_WAITING / 100 and taken(viewer) == []
