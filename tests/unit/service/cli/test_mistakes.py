"""Mistakes that people make, each with what the real command answers: docs/mistakes.md.

LOOPWRIGHT_WRITE_GOLDEN=1 python -m pytest tests/unit/service/cli/test_mistakes.py      writes the table again
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from loopwright.service.cli.main import main
from tests.unit.service.cli.columns import columns
from tests.unit.service.offline.exported_files import files_of, operated

PAGE = Path(__file__).parents[4] / "docs" / "mistakes.md"
BEGIN, END = "<!-- table -->\n", "<!-- end -->\n"
MODEL = '\'{"K": 0.8, "T_s": 120, "L_s": 15}\''
STEP = "".join(f"{5 * k},{35 if k < 9 else 41},{60 + max(0, k - 12) / 10}\n" for k in range(60))
IN_AUTOMATIC = files_of(*operated(2.0))
LOOP = """\
loops:
  - tag: TIC-101
    bus: virtual:site
    controller_node: 32
    plant_node: 16
    pv_unit: degC
    pv_limits: {low: 0, high: 100}
    t95_s: 300
    sp_deviation: 2
"""


@dataclass(frozen=True)
class Mistake:
    """A mistake, the command with which it is made, and the files that it needs. status: the exit status."""

    what: str
    command: str
    files: dict[str, str | bytes] = field(default_factory=dict)
    status: int = 2


Answer = Callable[[Mistake, Path], tuple[int, str]]


def csv(text: str) -> dict[str, str | bytes]:
    return {"data.csv": text}


def site(*changed: tuple[str, str]) -> dict[str, str | bytes]:
    text = LOOP
    for old, new in changed:
        assert old in text
        text = text.replace(old, new)
    return {"loops.yaml": text}


MISTAKES = [
    Mistake("The export is a workbook, not text.", "identify data.xlsx", {"data.xlsx": b"PK\x03\x04\x14\x00\x06\x00"}),
    Mistake("PV has a name of the plant's own.", "identify data.csv", csv("t,u,TI-4711\n" + STEP)),
    Mistake("The name after `--y` is misspelled.", "identify data.csv --y Tempratur", csv("t,u,Temperatur\n" + STEP)),
    Mistake("The file has no line of names.", "identify data.csv", csv(STEP)),
    Mistake(
        "The times are in ms, and nothing says so.", "identify data.csv",
        csv("t,u,y\n" + "".join(f"{100 * int(line.split(',')[0])}{line[line.index(','):]}\n" for line in STEP.split())),
    ),
    Mistake(
        "The file has no times.", "identify data.csv",
        csv("u,y\n" + "".join(f"{line.split(',', 1)[1]}\n" for line in STEP.split())),
    ),
    Mistake(
        "The columns have the words of a plant, or of a controller.", "identify data.csv",
        csv("t,Input,Output\n" + STEP),
    ),
    Mistake(
        "There are two loops in the file.", "identify data.csv",
        csv("t,TIC1.OP,TIC1.PV,TIC2.OP,TIC2.PV\n" + "".join(f"{line},35,{k}\n" for k, line in enumerate(STEP.split()))),
    ),
    Mistake(
        "The file is a list of events.", "identify data.csv",
        csv("Time,Event,Operator\n" + "".join(f"2026-11-25 10:00:{k:02},PV high,Ann\n" for k in range(20))),
    ),
    Mistake("MV and PV are swapped.", "identify data.csv", csv("t,y,u\n" + STEP)),
    Mistake(
        "The historian wrote a line for each value.", "identify data.csv",
        csv("TagName,Timestamp,Value\nTIC101.PV,2026-11-25 10:00:00,60.1\n"),
    ),
    Mistake("A column has text in it.", "identify data.csv", csv("t,u,y\n" + STEP.replace(",60.0\n", ",manual\n"))),
    Mistake(
        "The logger was off for a while.", "identify data.csv",
        csv("t,u,y\n" + "".join(line for line in STEP.splitlines(True) if not 100 <= int(line.split(",")[0]) < 200)),
    ),
    Mistake(
        "The historian stored changes alone.", "identify data.csv",
        csv("t,u,y\n" + STEP.replace("\n10,", "\n11.5,").replace("\n40,", "\n43,")),
    ),
    Mistake(
        "The times have whole seconds, and there are two samples in each.", "identify data.csv",
        csv("t,u,y\n" + "".join(f"10:00:{k // 2:02d},35,{60 + k / 10}\n" for k in range(60))),
    ),
    Mistake("MV never moved.", "identify data.csv", csv("t,u,y\n" + STEP.replace(",41,", ",35,"))),
    Mistake("The record is a few samples long.", "identify data.csv", csv("t,u,y\n0,35,60\n5,41,60\n10,41,61\n")),
    Mistake("`--resample` has no time.", "identify data.csv --resample often", csv("t,u,y\n" + STEP)),
    Mistake("Gains are given for a test in open loop.", "identify data.csv --kp 2", csv("t,u,y\n" + STEP)),
    Mistake("A test with steps of MV is called closed loop.", "identify data.csv --closed-loop", csv("t,u,y\n" + STEP)),
    Mistake(
        "The loop was in automatic, under a load.", "identify operation.csv --tune",
        {"operation.csv": IN_AUTOMATIC["scada"].content},
    ),
    Mistake(
        "The same without a column of SP.", "identify operation.csv --tune",
        {"operation.csv": IN_AUTOMATIC["dcs"].content},
    ),
    Mistake(
        "The same with gains that were not in effect.", "identify operation.csv --kp 8 --ti 100",
        {"operation.csv": IN_AUTOMATIC["scada"].content},
    ),
    Mistake(
        "The loop was in automatic, and nobody moved SP.", "identify operation.csv",
        {"operation.csv": "".join(IN_AUTOMATIC["scada"].content.decode("utf-16").splitlines(True)[:180])},
    ),
    Mistake(
        "Gains in effect are given, and the loop is called open.", "identify operation.csv --open-loop --kp 4",
        {"operation.csv": IN_AUTOMATIC["scada"].content},
    ),
    Mistake("A model is not complete.", "tune --model '{\"K\": 0.8}'"),
    Mistake("Names are those of a textbook.", 'tune --model \'{"K": 0.8, "tau": 120, "theta": 15}\''),
    Mistake("A value of a model is no number.", "tune --model K=0.8,T=2min,L=15"),
    Mistake("A time is negative.", 'tune --model \'{"K": 0.8, "T_s": -120, "L_s": 15}\''),
    Mistake("The gain is 0.", 'tune --model \'{"K": 0, "T_s": 120, "L_s": 15}\''),
    Mistake("The dead time is given in ms.", 'tune --model \'{"K": 0.8, "T_s": 120, "L_s": 15000000}\''),
    Mistake("The quotes are those of a word processor.", "tune --model '{“K”: 0.8}'"),
    Mistake("A method has another name.", f"tune --model {MODEL} --method lambda-tuning"),
    Mistake("An option is that of another method.", f"tune --model {MODEL} --method simc --option lambda_s=20"),
    Mistake("A proportional band without the span.", f"tune --model {MODEL} --form pb"),
    Mistake("A plot has a format that is none.", f"tune --model {MODEL} --plot tune.gif"),
    Mistake("The plant file is not there.", "rehearse heater.json"),
    Mistake(
        "The plant file is for another tool.", "rehearse heater.json",
        {"heater.json": '{"gain": 0.8, "tau": 120, "delay": 15}'},
    ),
    Mistake("A name in loops.yaml is misspelled.", "check loops.yaml", site(("t95_s", "T95"))),
    Mistake("The unit of PV is missing.", "check loops.yaml", site(("    pv_unit: degC\n", ""))),
    Mistake("T95 is text.", "check loops.yaml", site(("t95_s: 300", "t95_s: 5 min"))),
    Mistake("Plant and controller have one node-ID.", "check loops.yaml", site(("plant_node: 16", "plant_node: 32"))),
    Mistake("The step is larger than the limits allow.", "check loops.yaml", site(("deviation: 2", "deviation: 60"))),
    Mistake("The limits are swapped.", "check loops.yaml", site(("low: 0, high: 100", "low: 100, high: 0"))),
    Mistake("The bus has no kind.", "check loops.yaml", site(("virtual:site", "can0"))),
    Mistake("A tab in YAML.", "check loops.yaml", site(("    t95_s", "\tt95_s"))),
    Mistake("loops.yaml is not here.", "check loops.yaml"),
    Mistake("No service runs.", "loops --url http://127.0.0.1:9", {}, 1),
    Mistake("The address of the service lacks http.", "loops --url 127.0.0.1:8080"),
    Mistake("A node-ID is too large.", "serve --node 200"),
]  # fmt: skip


@pytest.fixture
def answered(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Answer:
    """The exit status and what the command says, in an empty folder with the files."""
    columns(monkeypatch, 200)

    def answer(mistake: Mistake, folder: Path) -> tuple[int, str]:
        monkeypatch.chdir(folder)
        for name, content in mistake.files.items():
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        monkeypatch.setattr(sys, "argv", ["loopwright", *shlex.split(mistake.command)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return int(ended.value.code or 0), (said.out + said.err).strip()

    return answer


def row(mistake: Mistake, said: str) -> str:
    cells = (mistake.what, f"`loopwright {mistake.command}`", "<br>".join(line.strip() for line in said.splitlines()))
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.what)
def test_a_mistake_is_answered_in_words(mistake: Mistake, tmp_path: Path, answered: Answer) -> None:
    status, said = answered(mistake, tmp_path)
    assert status == mistake.status, said
    assert "Traceback" not in said and str(tmp_path) not in said
    if "LOOPWRIGHT_WRITE_GOLDEN" not in os.environ:
        assert row(mistake, said) in PAGE.read_text(encoding="utf-8")


def test_the_table_is_that_of_the_mistakes(tmp_path: Path, answered: Answer) -> None:
    assert len(MISTAKES) >= 30
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    table, after = rest.split(END)
    if "LOOPWRIGHT_WRITE_GOLDEN" in os.environ:
        rows = []
        for i, mistake in enumerate(MISTAKES):
            folder = tmp_path / str(i)
            folder.mkdir()
            rows.append(row(mistake, answered(mistake, folder)[1]))
        table = "| mistake | command | answer |\n| --- | --- | --- |\n" + "".join(rows)
        PAGE.write_text(before + BEGIN + table + END + after, encoding="utf-8")
    assert table.count("\n") == 2 + len(MISTAKES)
