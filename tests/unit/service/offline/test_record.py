from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from loopwright.service.offline.csv_record import RecordError, load_record, parse_record
from loopwright.tuning.identification.identify import identify
from loopwright.tuning.models import FOPDT
from tests.unit.tuning.recordings import FIRST_ORDER, open_loop, step


def values(column: np.ndarray | None) -> list[float]:
    assert column is not None
    return [float(value) for value in column]


@pytest.mark.parametrize("name", ["t", "time", "t_s", "Time", " T_S "])
@pytest.mark.parametrize("mv", ["u", "mv", "MV"])
@pytest.mark.parametrize("pv", ["y", "pv", "PV"])
def test_accepted_names(name: str, mv: str, pv: str) -> None:
    record = parse_record(f"{name},{mv},{pv}\n0,50,20.5\n0.1,52,20.6\n", "test")
    assert values(record.t) == [0.0, 0.1]
    assert values(record.u) == [50.0, 52.0]
    assert values(record.y) == [20.5, 20.6]
    assert record.sp is None


@pytest.mark.parametrize(
    "text",
    [
        "comment,pv,sp,t,mv\nok,1.5,2,0,3\n,1.25,2,1,4\n",
        "comment;pv;sp;t;mv\nok;1,5;2;0;3\n;1,25;2;1;4\n",
        "comment;pv;sp;t;mv\nok, fine;1.5;2;0;3\n;1.25;2;1;4\n",
        "comment\tpv\tsp\tt\tmv\r\nok\t1,5\t2\t0\t3\r\n\t1,25\t2\t1\t4\r\n",
        '# of unit 3\n\ncomment,pv,sp,t,mv\n"a, b",1.5,2,0,3\n\n# here it moved\nc,1.25,2,1,4\n',
    ],
    ids=["comma", "semicolon and decimal comma", "semicolon and point", "tab", "comments and quotes"],
)
def test_delimiters_order_and_other_columns(text: str) -> None:
    record = parse_record(text, "test")
    assert (values(record.t), values(record.u)) == ([0.0, 1.0], [3.0, 4.0])
    assert (values(record.y), values(record.sp)) == ([1.5, 1.25], [2.0, 2.0])


@pytest.mark.parametrize("zone", ["", "Z", "+02:00"])
def test_dates(zone: str) -> None:
    moments = ["2024-03-31T01:59:59.5", "2024-03-31 02:00:00", "2024-03-31T02:00:00.500"]
    record = parse_record("time,u,y\n" + "".join(f"{moment}{zone},1,2\n" for moment in moments), "test")
    assert values(record.t) == [0.0, 0.5, 1.0]


def test_a_clock_without_a_zone_knows_no_summer_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    try:
        record = parse_record("time,u,y\n2024-03-31T01:59:59,1,2\n2024-03-31T03:00:00,1,2\n", "test")
    finally:
        monkeypatch.undo()
        time.tzset()
    assert values(record.t) == [0.0, 3601.0]


def test_a_file_with_a_byte_order_mark(tmp_path: Path) -> None:
    file = tmp_path / "record.csv"
    file.write_bytes(b"\xef\xbb\xbft,u,y\n0,1,2\n1,1,3\n")
    assert values(load_record(file).y) == [2.0, 3.0]


def test_every_error_is_listed_with_its_line() -> None:
    text = "# log\nt,u,y,sp\n0,1,2,3\n1,x,2,3\n1.5,,2,3\n2,1,nan,3\n\n3,1\n1,1,2,inf\n4,1,2,3\n"
    with pytest.raises(RecordError) as caught:
        parse_record(text, "log.csv")
    assert str(caught.value).startswith("log.csv: 6 errors")
    assert caught.value.problems == [
        "line 4: u is not a number: 'x'",
        "line 5: u is missing",
        "line 6: y is not finite: 'nan'",
        "line 8: 2 values where the first line names 4 columns",
        "line 9: t does not increase (1)",
        "line 9: sp is not finite: 'inf'",
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("# nothing\n\n", "is empty"),
        ("t,u,y\n", "no samples"),
        ("t,u\n0,1\n", "line 1: no column y or pv; there are: t, u"),
        ("0,1,2\n1,1,2\n", "no column t or time or t_s; there are: 0, 1, 2"),
        ("t,time,u,y\n0,0,1,2\n", "more than one column for t: t, time"),
        ("t,u,y\n2024-05-01T00:00:00,1,2\n5,1,2\n", "line 3: t is not a date and time: '5'"),
        ("t,u,y\n0,1,2\n2024-05-01T00:00:00,1,2\n", "line 3: t is not a number"),
    ],
)
def test_unusable_files(text: str, words: str) -> None:
    with pytest.raises(RecordError) as caught:
        parse_record(text, "log.csv")
    assert words in str(caught.value)


def test_only_the_first_errors_are_shown() -> None:
    with pytest.raises(RecordError, match=r"(?s)400 errors.*and 380 more"):
        parse_record("t,u,y\n" + "".join(f"{k},?,1\n" for k in range(400)), "log.csv")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"cannot be read: No such file"):
        load_record(tmp_path / "none.csv")
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00t")
    with pytest.raises(RecordError, match="not text in UTF-8"):
        load_record(binary)


def test_from_the_file_to_the_model(tmp_path: Path) -> None:
    t, u, y = open_loop(FIRST_ORDER, step())
    file = tmp_path / "step.csv"
    rows = "".join(f"{at:.2f};{mv:g};{pv:.4f}\n".replace(".", ",") for at, mv, pv in zip(t, u, y, strict=True))
    file.write_text("t;mv;pv\n" + rows)
    record = load_record(file)
    found = identify(record.t, record.u, record.y)
    assert isinstance(found.model, FOPDT)
    assert pytest.approx((2.0, 10.0, 2.03), rel=1e-3) == (found.model.K, found.model.T, found.model.L)
