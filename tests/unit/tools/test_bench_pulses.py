"""The benchmark of method setpoint goes on where it was interrupted, and its table counts what it holds."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from benchmarks import drawn_runs, pulses
from benchmarks.drawn_runs import saved
from benchmarks.plants import plants
from benchmarks.pulses import Pulsed, line

PLANT = plants()[0].name


def ran(present: str, seed: int = 1, **more: Any) -> Pulsed:
    return Pulsed("PI 1 %", PLANT, seed, 5.0, 1.0, present=present, Ms=1.61, ratio=1.0, **more)


def test_a_run_that_is_cut_off_in_the_file_is_made_again_and_the_others_are_not(tmp_path: Path) -> None:
    file = tmp_path / "runs.jsonl"
    kept = [ran("sluggish"), ran("typical")]
    file.write_text("".join(json.dumps(asdict(each)) + "\n" for each in kept) + '{"case": "PI 1')
    given = argparse.Namespace(
        cases="PI 1 %", kept_apart=False, of_batch=False, plants=1, part=(0, 1), seeds=range(1, 2), save=file,
        processes=1, method="setpoint", random=None,
    )  # fmt: skip
    asked: list[tuple[str, str]] = []

    class OneByOne:
        def __init__(self, processes: int) -> None: ...
        def __enter__(self) -> OneByOne:
            return self

        def __exit__(self, *ended: object) -> None: ...
        def imap_unordered(self, run: object, todo: list[tuple[object, str, str, int]]) -> list[Pulsed]:
            asked.extend((present, case) for _, present, case, _ in todo)
            return [ran(present) for _, present, _, _ in todo]

    with patch.object(drawn_runs, "get_context", lambda _: argparse.Namespace(Pool=OneByOne)):
        found = list(pulses.runs(given))
    assert asked == [("nearly unstable", "PI 1 %")]
    assert len(found) == 3 and saved(Pulsed, file) == found


def test_a_row_counts_proposals_errors_and_refusals() -> None:
    runs = [ran("typical", pv=1.0), ran("typical", 2, pv=1.4), ran("typical", 3, reason="uncertain", pv=0.5)]
    wrong = Pulsed("PI 1 %", PLANT, 4, 5.0, 1.0, present="typical", Ms=1.75, ratio=1.0)
    unstable = Pulsed("PI 1 %", PLANT, 5, 5.0, 1.0, present="typical")
    cells = [each.strip() for each in line("PI 1 %", "typical", [*runs, wrong, unstable]).split("|")]
    assert cells[3] == "4/5" and cells[7:9] == ["1", "1"] and cells[-2] == "uncertain 1"
    assert cells[9].endswith("/ 1.40")


def test_a_whole_run_is_judged_on_the_true_plant() -> None:
    plant = next(each for each in plants() if each.name == "P4_n=4")
    found = pulses.measure(plant, "nearly unstable", pulses.CASES["PI 1 %"], 1)
    assert found.reason is None and found.error < 0.05 and found.ratio == pytest.approx(1.0, abs=0.03)
    assert 0.5 < found.pv < 1.6 and found.passed < 8.0
