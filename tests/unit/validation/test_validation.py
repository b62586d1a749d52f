"""The validation itself: no number of a paper is out of its tolerance, its text is current, and it can fail."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from validation import __main__ as command
from validation import direct_synthesis, five_stage, imc, me_pso, s_plane
from validation.checks import Cell, Claim, Column, Paper, Row, Table, Tolerance, Verdict
from validation.figures import names
from validation.references import ROOT, References, load
from validation.report import document
from validation.run import validate

# seconds of work on an idle machine, far more on a crowded one
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def references() -> References:
    return load()


@pytest.fixture(scope="module")
def papers(references: References) -> list[Paper]:
    return validate(references)


def test_every_number_is_reproduced_or_explained(papers: list[Paper]) -> None:
    assert [line for paper in papers for line in paper.failures()] == []
    counts = [paper.counts() for paper in papers]
    assert len(counts) == 5
    assert all(each[Verdict.REPRODUCED] > 15 for each in counts)
    assert sum(each[Verdict.REPRODUCED] for each in counts) > 400


def test_the_document_is_what_the_run_gives(papers: list[Paper]) -> None:
    assert document(papers) == (ROOT / "docs/validation.md").read_text(encoding="utf-8"), "run make validate"


def test_every_plot_is_drawn_and_there(papers: list[Paper], references: References) -> None:
    wanted = {figure.name for paper in papers for figure in paper.figures}
    assert names(references) == wanted
    assert {path.stem for path in (ROOT / "docs/validation").iterdir()} == wanted


def set_at(tree: Any, path: tuple[str | int, ...], value: object) -> None:
    for key in path[:-1]:
        tree = tree[key]
    assert path[-1] in tree if isinstance(tree, dict) else True
    tree[path[-1]] = value


CHANGES: list[tuple[Callable[[References], Paper], str, tuple[str | int, ...], object, str]] = [
    # one print of each paper
    (five_stage.check, "five_stage", ("table4", "rows", 0, "printed", "GM"), 1.60, "P1: GM"),
    (direct_synthesis.check, "rules", ("direct_synthesis", "settings", 0, "printed", "Kp"), 0.33, "MDS: Kp"),
    (imc.check, "more", ("imc", "table1", 0, "printed", "IAE"), 5.0, "disturbance: IAE"),
    (s_plane.check, "search", ("paper_a", "printed", "table1_first", 1, "tc"), 9.6, "mu 0.4: tc"),
    (me_pso.check, "search", ("paper_b", "printed", "table4", "G2", "AMIGO", 4), 2.0, "AMIGO: overshoot"),
    # what an independent calculation gave, where the print is not met
    (five_stage.check, "five_stage", ("table2", "rows", 1, "settled", "OV"), 9.0, "instead of 9.0"),
    (me_pso.check, "search", ("paper_b", "recomputed", "best_found", "G4", "D", "criterion"), 500.0, "G4 duration"),
    # a print that is met after all, though a cause says why it is not
    (direct_synthesis.check, "rules", ("direct_synthesis", "settings", 2, "printed", "Ti"), 3.22, "(cause b)"),
    # an input: other numbers of its row
    (five_stage.check, "five_stage", ("table2", "rows", 0, "printed", "kp"), 0.4, "controller of model 1: ST"),
]


@pytest.mark.parametrize(
    ("check", "part", "path", "value", "told"), CHANGES, ids=lambda v: v if isinstance(v, str) else ""
)
def test_a_changed_reference_makes_it_fail(
    check: Callable[[References], Paper],
    part: str,
    path: tuple[str | int, ...],
    value: object,
    told: str,
    references: References,
    papers: list[Paper],
) -> None:
    changed = copy.deepcopy(references)
    set_at(getattr(changed, part), path, value)
    assert any(told in line for line in check(changed).failures())


def test_the_command_fails_and_names_the_row(
    references: References, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = copy.deepcopy(references)
    set_at(changed.more, ("imc", "table1", 0, "printed", "IAE"), 5.0)
    monkeypatch.setattr(command, "ROOT", tmp_path)
    monkeypatch.setattr(command, "DOCUMENT", tmp_path / "validation.md")
    monkeypatch.setattr(command, "PLOTS", tmp_path / "plots")
    monkeypatch.setattr(command, "load", lambda: changed)
    monkeypatch.setattr(command, "validate", lambda found: [imc.check(found)])
    assert command.main([]) == 1
    assert "FAILED: IMC-based PID, Table 1, row IMC-PID, disturbance: IAE printed 5.0" in capsys.readouterr().err
    assert "IAE **failed**" in (tmp_path / "validation.md").read_text(encoding="utf-8")
    assert len(list((tmp_path / "plots").iterdir())) == len(names(references))
    monkeypatch.setattr(command, "load", lambda: references)
    assert command.main([]) == 0


TENTH = Column("x", 2, Tolerance("for the test", absolute=0.1), own=Tolerance("for the test", relative=0.01))


@pytest.mark.parametrize(
    ("cell", "verdict"),
    [
        (Cell(1.0, 1.1), Verdict.REPRODUCED),
        (Cell(1.0, 1.11), Verdict.FAILED),
        (Cell(1.0, float("nan")), Verdict.FAILED),
        (Cell(None, 1.0), Verdict.FAILED),
        (Cell(1.0, 2.0, "a", 2.01), Verdict.EXPLAINED),
        (Cell(None, 2.0, "a", 2.01), Verdict.EXPLAINED),
        (Cell(1.0, 2.0, "a", 2.1), Verdict.FAILED),
        (Cell(1.0, 2.0, "a"), Verdict.FAILED),
        (Cell(1.0, 1.05, "a", 1.05), Verdict.FAILED),
        (Cell(1.0, None, "a"), Verdict.LOST),
        (Cell(1.0), Verdict.FAILED),
        (Cell(1.0, given=True), Verdict.GIVEN),
    ],
)
def test_verdicts(cell: Cell, verdict: Verdict) -> None:
    assert TENTH.verdict(cell) is verdict


def test_a_claim_holds_or_has_a_cause() -> None:
    verdicts = [Claim("", "", holds, cause).verdict for holds in (True, False) for cause in ("", "because")]
    assert verdicts == [Verdict.REPRODUCED, Verdict.FAILED, Verdict.FAILED, Verdict.EXPLAINED]


def test_how_numbers_are_shown() -> None:
    assert [TENTH.show(x) for x in (1.006, -0.001, None)] == ["1.01", "0.00", "–"]
    assert [TENTH.as_printed(x) for x in (5.717, 2.5, 3, None)] == ["5.717", "2.50", "3.00", "–"]
    rows = (Row("first", (Cell(1.0, 1.0), Cell(1.0, 2.0, "a", 2.0))), Row("second", (Cell(1.0), Cell(1.0, cause="a"))))
    text = document([Paper("A paper", "Somebody", "", (Table("T", (TENTH, TENTH), rows, causes={"a": "Why."}),))])
    assert "| first | 1.00 · 1.00 | 1.00 · 2.00 | x explained (a); rest reproduced |" in text
    assert "| second | 1.00 · 1.00 | – · – | x **failed**; x cannot be recomputed (a) |" in text
    assert "| [A paper](#a-paper) | 1 | 0 | 1 | 1 | 1 |" in text
