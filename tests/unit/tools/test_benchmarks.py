"""`make bench` where something is missing: what can be measured is, and the table has words for the rest."""

from __future__ import annotations

import json
import sys

import pytest

from benchmarks.__main__ import Benchmark, main
from benchmarks.command import CANNOT

ME_PSO = {
    "no_dead_time_s": 0.5, "no_dead_time_evaluations": 2500.0, "dead_time_s": 6.0, "dead_time_evaluations": 2500.0,
}  # fmt: skip


def benchmark(script: str, lacks: str = "") -> Benchmark:
    return Benchmark((sys.executable, "-c", script), lacks)


MEASURED = benchmark(f"print('  progress'); print({json.dumps(ME_PSO)!r})")
LACKS = benchmark(f"import sys; sys.exit({CANNOT})", "no CAN interface vcan0 is to be had")
BREAKS = benchmark("raise SystemExit('it broke')")
SAYS_NOTHING = benchmark("print('done')")


def test_one_that_lacks_something_has_a_row_that_says_what(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([], {"bus": LACKS, "me_pso": MEASURED}) == 0
    told = capsys.readouterr()
    assert "| bus | not measured: no CAN interface vcan0 is to be had |  |  |" in told.out
    assert "| ME-PSO, no dead time, 2,500 step responses | 0.50 s | 2 s | met |" in told.out
    assert "| ME-PSO, dead time, 2,500 step responses | 6.00 s | 5 s | **missed** |" in told.out
    assert "vcan by" not in told.out


@pytest.mark.parametrize(
    ("wrong", "words"), [(BREAKS, "it ended with status 1"), (SAYS_NOTHING, "it ended without figures")]
)
def test_one_that_goes_wrong_does_not_end_the_others(
    capsys: pytest.CaptureFixture[str], wrong: Benchmark, words: str
) -> None:
    assert main([], {"tune": wrong, "me_pso": MEASURED}) == 1
    told = capsys.readouterr()
    assert f"| tune | not measured: {words}" in told.out and "| ME-PSO, no dead time" in told.out
    assert "Traceback" not in told.out + told.err


def test_a_status_of_cannot_means_it_only_where_something_can_be_lacking(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([], {"tune": benchmark(f"import sys; sys.exit({CANNOT})")}) == 1
    assert f"it ended with status {CANNOT}" in capsys.readouterr().out


def test_figures_that_were_asked_for_by_name_are_all_there_or_it_fails(capsys: pytest.CaptureFixture[str]) -> None:
    benchmarks = {"bus": LACKS, "me_pso": MEASURED}
    assert main(["me_pso"], benchmarks) == 0
    assert json.loads(capsys.readouterr().out) == {"me_pso": ME_PSO}
    assert main(["me_pso", "bus"], benchmarks) == 1
    told = capsys.readouterr()
    assert json.loads(told.out) == {"me_pso": ME_PSO} and "bus: not measured: no CAN" in told.err
