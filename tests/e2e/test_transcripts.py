"""The days of three strangers, docs/transcripts/: every command is run, and every answer is what the document shows.

    LOOPWRIGHT_WRITE_GOLDEN=1 python -m pytest tests/e2e/test_transcripts.py      writes the answers again

Answers with measured values are written anew only where they differ by more than a run differs from the next.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.e2e.transcript import Shell, alike, blocks, differences, written
from tests.unit.service.offline.exported_files import FILES

FOLDER = Path(__file__).parents[2] / "docs" / "transcripts"


@dataclass(frozen=True)
class Day:
    """A transcript. ports: those that it names. within: by which part the numbers of two runs differ. pictures: files
    that its commands write. data: files that its reader has."""

    name: str
    ports: tuple[int, ...] = ()
    within: float = 1e-3
    pictures: tuple[str, ...] = ()
    data: tuple[str, ...] = ()


DAYS = (
    Day("commissioning.md", (8080, 29536), within=0.2, pictures=("job.svg",)),
    Day("automation.md", (8080, 29536, 9000), within=0.2),
    Day("teaching.md", within=0.01, pictures=("methods.svg", "fit.svg"), data=("heater.csv",)),
)


@pytest.mark.parametrize("day", DAYS, ids=lambda day: day.name)
def test_a_day_goes_as_it_is_written(day: Day, tmp_path: Path) -> None:
    page = FOLDER / day.name
    text = page.read_text(encoding="utf-8")
    write = "LOOPWRIGHT_WRITE_GOLDEN" in os.environ
    for name in day.data:
        shutil.copy(FOLDER / name, tmp_path)
    after, at, all_alike = "", 0, True
    with Shell(tmp_path, day.ports) as shell:
        for block in blocks(text):
            if block.name:
                shell.save(block.name, block.content)
                continue
            after += text[at : block.start]
            at = block.end
            for said in block.said:
                answer = shell.run(said.command)
                assert "Traceback" not in answer, answer
                if not alike(said.shown, answer, day.within):
                    if not write:
                        pytest.fail("\n".join([said.command, *differences(said.shown, answer, day.within), answer]))
                    all_alike = False
                after += written(said, answer)
    if write and not all_alike:  # the answers of one document are those of one run
        page.write_text(after + text[at:], encoding="utf-8")
    assert all((tmp_path / name).stat().st_size > 1000 for name in day.pictures)


def test_the_teachers_file_is_one_that_is_read_elsewhere_too() -> None:
    assert (FOLDER / "heater.csv").read_bytes() == FILES["spreadsheet"].content.decode("cp1252").encode()


def test_every_transcript_is_run() -> None:
    assert {day.name for day in DAYS} == {page.name for page in FOLDER.glob("*.md")} - {"index.md"}


@pytest.mark.parametrize(("shown", "answer", "same"), [
    ("Kp 4.311, Ti 60.7 s", "Kp 4.4,  Ti\n59.8 s", True),
    ("Kp 4.311, Ti 60.7 s", "Kp 6.311, Ti 60.7 s", False),
    ("│ gain Kp │ 4.3 │", "│ gain Kp │    4.31 │", True),
    ("proposed", "refused", False),
    ("Ms 1.60 ± 0.004", "Ms 1.61 ± 0.002", True),
    ("two lines\nof text", "two lines", False),
    ("busy with job 1, waiting for its turn since 2", "busy with job 1, under way since 2", True),
])  # fmt: skip
def test_what_counts_as_the_same(shown: str, answer: str, same: bool) -> None:
    assert alike(shown, answer, 0.2) is same


def test_exact_numbers_are_compared_exactly() -> None:
    assert alike("Kp 4.311", "Kp 4.311", 1e-3) and not alike("Kp 4.311", "Kp 4.33", 1e-3)
    assert not alike("Kp 0.011", "Kp 0.018", 1e-3)
