from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from loopwright.service.offline.csv_record.errors import RecordError
from loopwright.service.offline.csv_record.record import ReadOptions, Record, load_record, parse_record
from loopwright.service.offline.csv_record.sampling import duration
from loopwright.service.offline.csv_record.swapped import may_be_swapped
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


@pytest.mark.parametrize(
    ("before", "after"), [("25/11/30", "25/12/01"), ("30/11/25", "01/12/25"), ("11/30/25", "12/01/25")]
)
def test_over_midnight_two_digits_of_the_year_may_come_first_or_last(before: str, after: str) -> None:
    record = parse_record(f"time,u,y\n{before} 23:59:59,1,2\n{after} 00:00:00,1,2\n{after} 00:00:01,1,2\n", "test")
    assert values(record.t) == [0.0, 1.0, 2.0]


def test_a_clock_without_a_zone_knows_no_summer_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    try:
        record = parse_record("time,u,y\n2024-03-31T01:59:59,1,2\n2024-03-31T03:00:00,1,2\n", "test")
    finally:
        monkeypatch.undo()
        time.tzset()
    assert values(record.t) == [0.0, 3601.0]


def test_an_hour_that_the_clock_leaves_out_or_has_twice_is_named() -> None:
    def lines(first: str, then: str) -> str:
        return "time,u,y\n" + "".join(f"2024-{hour}:{k:02}:00,1,{k}\n" for hour in (first, then) for k in range(60))

    with pytest.raises(RecordError, match=r"line 62: the time does not increase: the clock went back.* in UTC"):
        parse_record(lines("10-27T02", "10-27T02"), "log.csv")
    spring = lines("03-31T01", "03-31T03")
    with pytest.raises(RecordError, match=r"line 62: 3660 s after the sample before.* as summer time begins, export"):
        parse_record(spring, "log.csv")
    record = parse_record(spring, "log.csv", ReadOptions(resample_s=60.0))
    assert "PV has no value for an hour. If it is the one left out as summer time begins" in record.notes[1]
    with pytest.raises(RecordError, match=r"line 4: the time does not increase: samples of the same time and other"):
        parse_record("time,u,y\n2024-10-25,1,1\n2024-10-26,1,2\n2024-10-26,1,3\n2024-10-27,1,4\n", "log.csv")


def test_a_file_with_a_byte_order_mark(tmp_path: Path) -> None:
    file = tmp_path / "record.csv"
    file.write_bytes(b"\xef\xbb\xbft,u,y\n0,1,2\n1,1,3\n")
    assert values(load_record(file).y) == [2.0, 3.0]


def test_every_error_is_listed_with_its_line() -> None:
    text = "# log\nt,u,y,sp\n0,1,2,3\n1,x,2,3\n1.5,,2,3\n2,1,nan,3\n\n3,1\nzwei,y,2,inf\n4,1,2,3\n"
    with pytest.raises(RecordError) as caught:
        parse_record(text, "log.csv")
    assert str(caught.value).startswith("log.csv: 4 errors")
    assert caught.value.problems == [
        "line 9: t is neither a number of s nor a date and time: 'zwei'; --time-format says how it is written",
        "line 8: values are missing, or too many: line 2 names 4 columns; complete or delete it",
        "2 values of u are not numbers, such as 'x', in lines 4, 9: leave cells without a value empty",
        "line 9: sp is not a number: 'inf': leave cells without a value empty",
    ]


def test_of_each_kind_of_error_the_first_lines_are_named() -> None:
    with pytest.raises(RecordError) as caught:
        parse_record("t,u,y\n" + "".join(f"{k},?!,1\n" for k in range(400)), "log.csv")
    assert caught.value.problems == [
        "400 values of u are not numbers, such as '?!', first in lines 2, 3, 4, 5, 6: leave cells without a value empty"
    ]


def test_times_that_do_not_increase() -> None:
    with pytest.raises(RecordError, match=r"line 4: the time does not increase: put the lines into the order"):
        parse_record("t,u,y\n0,1,2\n2,1,2\n1,1,2\n3,1,2\n", "log.csv")
    with pytest.raises(RecordError, match="2 times do not increase, in lines 3, 5: samples of the same time"):
        parse_record("t,u,y\n10:00:00,1,2\n10:00:00,1,3\n10:00:01,1,4\n10:00:01,1,5\n", "log.csv")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("# nothing\n\n", "is empty"),
        ("t,u,y\n", "no samples"),
        ("t,u\n0,1\n", "process variable, ...); there are: t, u. Say which: --y NAME"),
        ("0,1,2\n1,1,2\n", "no column for the time: the line has no names. Give its number, as --t 1"),
        (
            "t,time,u,y\n0,0,1,2\n",
            "more than one column for the time: t (column 1) or time (column 2). Say which: --t NAME",
        ),
        ("t,u,y\n2024-05-01T00:00:00,1,2\n5,1,2\n", "line 3: t is no time that is known; --time-format says"),
        ("t,u,y\n0,1,2\n2024-05-01T00:00:00,1,2\n", "neither a number of s nor a date and time: '2024-05-01T00:00:00'"),
    ],
)
def test_unusable_files(text: str, words: str) -> None:
    with pytest.raises(RecordError) as caught:
        parse_record(text, "log.csv")
    assert words in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"cannot be read: No such file"):
        load_record(tmp_path / "none.csv")
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00\xd8\x01\x00")
    with pytest.raises(RecordError, match="not text in UTF-16-LE: byte 0"):
        load_record(binary)
    binary.write_bytes(b"PK\x03\x04\x14\x00\x06\x00\x08\x00sheet")
    with pytest.raises(RecordError, match=r"it is a workbook or another archive\. Save the sheet"):
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


def seconds_of(header: str, *times: str) -> list[float]:
    return values(parse_record(f"{header};u;y\n" + "".join(f"{each};1;2\n" for each in times), "log.csv").t)


@pytest.mark.parametrize(
    ("header", "times", "found"),
    [
        ("time (ms)", ("0", "500", "1000"), [0.0, 0.5, 1.0]),
        ("time [min]", ("0", "0,5", "1"), [0.0, 30.0, 60.0]),
        ("t_h", ("0", "0.5", "1"), [0.0, 1800.0, 3600.0]),
        ("time", ("1795600000", "1795600002"), [0.0, 2.0]),  # s since 1970
        ("time", ("1795600000000000000", "1795600000500000000"), [0.0, 0.5]),  # ns since 1970
        ("time", ("134400000000000000", "134400000005000000"), [0.0, 0.5]),  # 100 ns since 1601
        ("timestamp", ("46351.5", "46351.50005787037"), [0.0, 5.0]),  # days of a spreadsheet
        ("time", ("46351.5", "46351.55"), [46351.5, 46351.55]),  # s, twenty times a second
        ("time", ("46351.00000000", "46351.01041667"), [0.0, 900.0003]),
        ("time", ("46351,0000", "46351,0417", "46351,0833"), [0.0, 3602.88, 7197.12]),  # hours, to 9 s
        ("time", ("46351.0", "46351.041666666664"), [0.0, 3600.0]),
        ("time", ("46351.0", "46351.3333"), [0.0, 28797.12]),
        ("time", ("740000.00000000", "740000.00347222"), [0.0, 299.9998]),  # MATLAB
        ("time", ("20261125235955", "20261126000000", "20261126000005"), [0.0, 5.0, 10.0]),
        ("time", ("202611252359", "202611260000", "202611260001"), [0.0, 60.0, 120.0]),
        ("time", ("2026112523", "2026112600"), [0.0, 3600.0]),
        ("time", ("20261125 235955", "20261126 000000,5"), [0.0, 5.5]),
        ("time", ("20261125T235955", "20261126T000000"), [0.0, 5.0]),
        ("time", ("20261125235959250", "20261126000000000"), [0.0, 0.75]),
        ("time", ("2026112510", "2026112560"), [0.0, 50.0]),  # s since 1970: no hour 60
        ("time", ("1979123123000", "1979123123500"), [0.0, 0.5]),  # ms since 1970
        ("time (ms)", ("200000000", "200000500"), [200000.0, 200000.5]),  # a counter of a PLC
        ("time", ("23:59:55", "00:00:00", "0:00:05"), [86395.0, 86400.0, 86405.0]),
        ("time", ("12:00:00 AM", "12:00:05 a.m."), [0.0, 5.0]),
        ("time", ("25-Nov-2026 23:59:59,5", "26-Nov-2026 00:00:00,0"), [0.0, 0.5]),
        ("time", ("2026/11/25 10:00", "2026/11/25 10:01"), [0.0, 60.0]),
        ("time", ("31.12.26 23:59:59", "01.01.27 00:00:00"), [0.0, 1.0]),
        ("time", ("12/31/2026 23:59:59", "01/01/2027 00:00:00"), [0.0, 1.0]),
        ("time", ("01/02/2026 23:59:59", "02/02/2026 00:00:00"), [0.0, 1.0]),
        ("time", ("02/01/2026 23:59:59", "02/02/2026 00:00:00"), [0.0, 1.0]),
    ],
)
def test_times_as_systems_write_them(header: str, times: tuple[str, ...], found: list[float]) -> None:
    assert seconds_of(header, *times) == pytest.approx(found, abs=1e-4)


@pytest.mark.parametrize(
    ("unit", "s"),
    [
        ("ns", 1e-9), ("us", 1e-6), ("µs", 1e-6), ("\u03bcs", 1e-6), ("Microseconds", 1e-6), ("msec", 1e-3),
        ("milliseconds", 1e-3), ("S", 1.0), ("sec.", 1.0), ("Seconds", 1.0), ("mins", 60.0), ("Min.", 60.0),
        ("minutes", 60.0), ("hr", 3600.0), ("hrs", 3600.0), ("hours", 3600.0), ("d", 86400.0), ("Days", 86400.0),
    ],
)  # fmt: skip
def test_units_of_time_in_words(unit: str, s: float) -> None:
    for header in (f"Time ({unit})", f"time [{unit}]", f"Time_{unit}", f"time / {unit}"):
        assert seconds_of(header, "0", "0.5", "1") == pytest.approx([0.0, 0.5 * s, s])
    below = parse_record(f"Time;u;y\n({unit});%;degC\n0;1;2\n0.5;1;2\n", "log.csv")
    assert values(below.t) == pytest.approx([0.0, 0.5 * s])
    described = parse_record(f"Time;u;y\nTime;Valve;Temperature\n{unit};%;degC\n0;1;2\n0.5;1;2\n", "log.csv")
    assert values(described.t) == pytest.approx([0.0, 0.5 * s])
    for name in (f"Elapsed_{unit}", f"Zeit / {unit}", unit):
        chosen = parse_record(f"{name};u;y\n0;1;2\n0.5;1;2\n", "log.csv", ReadOptions({"t": "1"}))
        assert values(chosen.t) == pytest.approx([0.0, 0.5 * s])


def test_a_unit_of_time_that_is_not_known_is_never_taken_for_s() -> None:
    known = "which is not known; put one of ns, us, ms, s, min, h and d in its place, as in 'Time (min)'"
    below = "Time;u;y\nticks of the PLC;%;degC\n0;1;2\n1;1;2\n"
    for text, unit in (("Time (weeks);u;y\n0;1;2\n1;1;2\n", "weeks"), (below, "ticks of the PLC")):
        with pytest.raises(RecordError) as caught:
            parse_record(text, "log.csv")
        assert f"has the unit '{unit}', {known}" in str(caught.value)


@pytest.mark.parametrize(
    ("header", "times", "found"),
    [
        ("Time (UTC)", ("0", "5"), [0.0, 5.0]),
        ("Time (local)", ("0", "5"), [0.0, 5.0]),
        ("Time (CET)", ("25.11.2026 10:00:00", "25.11.2026 10:00:05"), [0.0, 5.0]),
        ("Time (since 1970)", ("1795600000", "1795600005"), [0.0, 5.0]),
        ("Time (Excel)", ("46351.5", "46351.50005787037"), [0.0, 5.0]),
        ("Time (mm:ss)", ("59:55", "59:57.5"), [3595.0, 3597.5]),
    ],
)
def test_what_is_no_unit_of_time(header: str, times: tuple[str, ...], found: list[float]) -> None:
    assert seconds_of(header, *times) == pytest.approx(found, abs=1e-4)


@pytest.mark.parametrize("times", [("46351", "46352"), ("46351.0", "46351.25"), ("46351.0", "46351.0333")])
def test_numbers_that_may_be_days_or_s(times: tuple[str, str]) -> None:
    with pytest.raises(RecordError, match=r"from 46351 on, .* apart: they may be days of a spreadsheet or s; put the"):
        seconds_of("time", *times)
    step = float(times[1]) - float(times[0])
    for unit, s in (("d", 86400.0), ("s", 1.0)):
        assert np.diff(seconds_of(f"time ({unit})", *times)) == pytest.approx([step * s])


def test_date_and_time_apart_as_numbers() -> None:
    text = "Date;Time;u;y\n20261125;235955;1;2\n20261126;000000;1;2\n"
    assert values(parse_record(text, "log.csv").t) == [0.0, 5.0]


def test_a_unit_of_time_that_cannot_be() -> None:
    with pytest.raises(RecordError, match=r"begins at 1\.764e\+12 s, more than 3000 years, in the unit 's'; put one"):
        seconds_of("time (s)", "1764000000000", "1764000005000")


def test_a_time_format_that_is_given() -> None:
    text = "when;u;y\nday 330, 10h00;1;2\nday 330, 10h01;1;2\n"
    reading = ReadOptions({"t": "when"}, "day %j, %Hh%M")
    assert values(parse_record(text, "log.csv", reading).t) == [0.0, 60.0]
    with pytest.raises(RecordError, match="2 values of when are no times of the form '%H:%M', such as 'day 330, 10h00"):
        parse_record(text, "log.csv", ReadOptions({"t": "when"}, "%H:%M"))


@pytest.mark.parametrize(
    ("cell", "value"),
    [
        ("1.234,5", 1234.5),
        ("1,234.5", 1234.5),
        ("1 234,5", 1234.5),
        ("1\u00a0234,5", 1234.5),
        ("35,2 %", 35.2),
        ("-1,5e-3", -0.0015),
    ],
)
def test_numbers_as_people_write_them(cell: str, value: float) -> None:
    assert values(parse_record(f"t;u;y\n0;{cell};2\n1;{cell};2\n", "log.csv").u) == [value, value]


@pytest.mark.parametrize(
    ("delimiter", "cells", "found", "note"),
    [
        (";", ("0;35,00;1.200", "5;35,00;1.130"), [1200.0, 1130.0], "The point of y ('1.200') was taken to separate"),
        ("\t", ("0\t35.00\t1,200", "5\t35.00\t998"), [1200.0, 998.0], "The comma of y ('1,200') was taken to separate"),
        (",", ('0,35.00,"1,200"', '5,35.00,"998"'), [1200.0, 998.0], "The comma of y ('1,200') was taken to separate"),
        (";", ("0;35;1,200.5", "5;35;1,201"), [1200.5, 1201.0], ""),
        (";", ("0;35;1,234,567", "5;35;1,201"), [1234567.0, 1201.0], ""),
        (";", ("0;35;1 234,567", "5;35;1,201"), [1234.567, 1.201], ""),
        (";", ("0;35;0,125", "5;35;1,201"), [0.125, 1.201], ""),
        (",", ('0,"35,5","60,25"', '5,"35,5","60,5"'), [60.25, 60.5], ""),
        (";", ("0;35,5;60,016", "5;35,5;Bad", "10;35,5;60,018"), [60.016, 60.017, 60.018], ""),
        (";", ("0;35;998", "5;35;1,000"), [998.0, 1000.0], "to separate thousands: otherwise values would jump"),
        (";", ("0;35;35", "5;35;41,125"), [35.0, 41.125], "for the decimal sign: otherwise values would jump"),
        (";", ("0;35;1,200", "5;35;1,201"), [1.2, 1.201], "for the decimal sign, which no number of it shows; if it"),
        (";", ("0;35;1.200", "5;35;1.201"), [1.2, 1.201], "for the decimal sign, which no number of it shows; if it"),
        (",", ("0,35,1.200", "5,35,1.201"), [1.2, 1.201], ""),
        (",", ('0,35,"1,200"', '5,35,"1,201"'), [1200.0, 1201.0], "to separate thousands, which no number of it shows"),
    ],
)  # fmt: skip
def test_thousands_and_decimals(delimiter: str, cells: tuple[str, ...], found: list[float], note: str) -> None:
    allowing_gaps = ReadOptions(resample_s=5.0) if any("Bad" in cell for cell in cells) else ReadOptions()
    record = parse_record(delimiter.join("tuy") + "\n" + "\n".join(cells) + "\n", "log.csv", allowing_gaps)
    assert values(record.y) == pytest.approx(found, rel=1e-12)
    taken = [each for each in record.notes if " was taken " in each]
    assert len(taken) == bool(note) and all(note in each for each in taken)


def test_thousands_in_times() -> None:
    quoted = parse_record('"time (s)","u","y"\n"995","35.00","2.5"\n"1,000","35.00","2.5"\n', "log.csv")
    assert values(quoted.t) == [995.0, 1000.0]
    assert values(parse_record("t\tu\ty\n995\t1\t2\n1,000\t1\t2\n1,005\t1\t2\n", "log.csv").t) == [
        995.0,
        1000.0,
        1005.0,
    ]


def test_numbers_that_cannot_be_read_alike() -> None:
    with pytest.raises(RecordError, match=r"y has numbers with point and with comma: '1\.5' and '2,5'; write one"):
        parse_record("t;u;y\n0;1;1.5\n1;1;2,5\n", "log.csv")
    with pytest.raises(RecordError, match=r"2 values of t are not numbers as those before, such as '20261125 90000'"):
        parse_record("t;u;y\n20261125 90000;1;2\n20261125 90100;1;2\n", "log.csv")


def test_columns_by_number_where_there_are_no_names() -> None:
    reading = ReadOptions({"t": "1", "u": "3", "y": "2"})
    for text in ("0 5 1\n2 6 1\n", "  0   5   1\n  2   6   1\n", "0\t5\t1\n2\t6\t1\n"):
        record = parse_record(text, "log.txt", reading)
        assert (values(record.t), values(record.u), values(record.y)) == ([0.0, 2.0], [1.0, 1.0], [5.0, 6.0])


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"u": "valve"}, "--u: no column 'valve'; did you mean Valve 2?; there are: t, Valve 1, Valve 2, y"),
        ({"u": "9"}, "--u: no column '9'"),
        ({"u": "y"}, "column 'y' is chosen for more than one quantity"),
    ],
)
def test_columns_that_are_not_there(chosen: dict[str, str], words: str) -> None:
    with pytest.raises(RecordError) as caught:
        parse_record("t,Valve 1,Valve 2,y\n0,1,2,3\n", "log.csv", ReadOptions(chosen))
    assert words in str(caught.value)


def test_a_file_in_utf_16_without_a_mark(tmp_path: Path) -> None:
    file = tmp_path / "record.csv"
    file.write_bytes("t,u,y\n0,1,2\n1,1,3\n".encode("utf-16-le"))
    assert values(load_record(file).y) == [2.0, 3.0]


def rows(*cells: str) -> str:
    return "t,u,y\n" + "".join(f"{k},1,{cell}\n" for k, cell in enumerate(cells))


def test_values_that_are_missing() -> None:
    there = ["2"] * 60
    record = parse_record(rows(*there, "3", "Bad", "", "6", *there, "No Data"), "log.csv")
    assert values(record.y[60:64]) == [3.0, 4.0, 5.0, 6.0]
    assert record.notes == (
        "1 sample without values at the ends was left out.",
        "2 samples without a value, at most 2 in a row, were filled: MV and set-point held, PV in a straight line.",
    )
    with pytest.raises(RecordError, match="4 samples in a row have no value, from 60 s on"):
        parse_record(rows(*there, *[""] * 4, *there), "log.csv")
    with pytest.raises(RecordError, match="9 of 68 samples have no value; at most 5 % are filled"):
        parse_record(rows(*["2", ""] * 9, *["2"] * 50), "log.csv")
    with pytest.raises(RecordError, match="no sample has values of all columns"):
        parse_record(rows("", "", "nan"), "log.csv")


@pytest.mark.parametrize(
    ("setpoints", "lacking"), [(["Bad"] * 60, 60), (["60", *[""] * 4] * 12, 48), ([*[""] * 40, *["60"] * 20], 40)]
)
def test_a_set_point_that_lacks_values_costs_no_sample(setpoints: list[str], lacking: int) -> None:
    text = "t,u,y,sp\n" + "".join(f"{k},1,{k},{sp}\n" for k, sp in enumerate(setpoints))
    record = parse_record(text, "log.csv")
    assert record.sp is None and values(record.y) == [float(k) for k in range(60)]
    assert record.notes == (
        f"The set-point was left out: {lacking} of 60 samples have no value of it, more than are filled.",
    )
    assert record.without_setpoint == "the column of SP (sp) lacks too many values"


def test_a_set_point_with_a_few_gaps_is_filled_as_before() -> None:
    text = "t,u,y,sp\n" + "".join(f"{k},1,{k},{'' if k in (0, 30, 31) else 60}\n" for k in range(60))
    record = parse_record(text, "log.csv")
    assert values(record.sp) == [60.0] * 60 and len(record.notes) == 1 and "3 samples without" in record.notes[0]


@pytest.mark.parametrize(("first", "there"), [(1, True), (40, False), (60, False)])
def test_a_set_point_that_begins_late_costs_no_resampled_record(first: int, there: bool) -> None:
    text = "t,u,y,sp\n" + "".join(f"{k},1,{k},{60 if k >= first else ''}\n" for k in range(60))
    record = parse_record(text, "log.csv", ReadOptions(resample_s=1.0))
    assert (record.sp is not None) is there and len(record.t) == (59 if there else 60)
    assert there or record.notes[0].startswith("The set-point was left out: it has ")


def test_lines_that_are_missing_or_repeated() -> None:
    lines = [f"{k},1,{k}" for k in range(100)]
    record = parse_record("\n".join(["t,u,y", *lines[:50], lines[49], *lines[52:]]), "log.csv")
    assert values(record.t) == values(record.y) == [float(k) for k in range(100)]
    assert record.notes[0] == "1 line that repeats the one before was left out."
    with pytest.raises(RecordError, match=r"line 52: 5 s after the sample before, where 1 s is usual \(1 such gap\)"):
        parse_record("\n".join(["t,u,y", *lines[:50], *lines[54:]]), "log.csv")
    with pytest.raises(RecordError, match=r"line 3 comes 1\.4 s after the sample before.*--resample 1s"):
        parse_record("\n".join(["t,u,y", lines[0], "1.4,1,1", *lines[2:]]), "log.csv")


def test_resampling_keeps_what_mv_did_to_the_plant() -> None:
    text = "t,u,y\n0,0,0\n1.5,4,3\n4,4,8\n6,4,12\n"
    record = parse_record(text, "log.csv", ReadOptions(resample_s=2.0))
    # MV moves at 1.5 s: a quarter of the interval is left; PV is 2 t
    assert (values(record.t), values(record.u)) == ([0.0, 2.0, 4.0, 6.0], [1.0, 4.0, 4.0, 4.0])
    assert values(record.y) == [0.0, 4.0, 8.0, 12.0]
    assert "PV every 2 s, at most 2.5 s apart" in record.notes[0]


def test_resampling_says_where_mv_was_held_although_it_is_not_known() -> None:
    lines = [f"{k},{'I/O Timeout' if 10 < k < 30 else '' if k % 2 else 1 + (k > 20)},{k}" for k in range(60)]
    record = parse_record("\n".join(["t,u,y", *lines]), "log.csv", ReadOptions(resample_s=1.0))
    assert record.notes[0].startswith("19 lines have no value of u, such as 'I/O Timeout' in line 13: the value before")
    assert "no value" not in " ".join(record.notes[1:])


def test_resampling_ends_with_the_last_value_of_pv() -> None:
    lines = [f"{k},1,{'Bad' if k > 20 else k}" for k in range(60)]
    record = parse_record("\n".join(["t,u,y", *lines]), "log.csv", ReadOptions(resample_s=1.0))
    assert values(record.y) == [float(k) for k in range(21)]


@pytest.mark.parametrize(
    ("header", "line", "bad", "lacking"),
    [
        ("t,u,y,Quality", "{k},1,{y},{q}", ("Good", "Bad"), {"u", "y"}),
        ("t,u,u_q,y,y_q", "{k},1,192,{y},{q}", ("192", "24"), {"y"}),
        ("t,u,TIC 1.PV (degC),TIC 1.PV Status", "{k},1,{y},{q}", ("OK", "Bad: sensor failure"), {"y"}),
        ("t,u,Quality,y,Quality", "{k},1,Good,{y},{q}", ("Good", "BAD"), {"y"}),
        ("t,u,y,y status", "{k},1,{y},{q}", ("", "Scan Off"), {"y"}),
        ("t,y,u,Status", "{k},{y},1,{q}", ("1", "0"), set()),  # of no known meaning
        ("t,u,y,q", "{k},1,{y},{q}", ("150.5", "3.2"), set()),  # a flow of heat
    ],
)
def test_values_of_bad_quality_are_none(header: str, line: str, bad: tuple[str, str], lacking: set[str]) -> None:
    lines = [line.format(k=k, y=0 if k in (30, 31) else k, q=bad[k in (30, 31)]) for k in range(60)]
    record = parse_record("\n".join([header, *lines]), "log.csv")
    assert values(record.y[29:33]) == ([29.0, 30.0, 31.0, 32.0] if lacking else [29.0, 0.0, 0.0, 32.0])
    if not lacking:
        assert record.notes == ()
        return
    whose = " and ".join(record.names[each] for each in sorted(lacking))
    assert record.notes[0].startswith(f"2 lines mark {whose} as bad (") and "2 samples without" in record.notes[1]
    many = [line.format(k=k, y=k, q=bad[20 <= k < 40]) for k in range(60)]
    with pytest.raises(RecordError, match="20 samples in a row have no value, from 20 s on"):
        parse_record("\n".join([header, *many]), "log.csv")


def test_between_spaces_a_value_that_is_missing_moves_no_other_into_its_column() -> None:
    lines = [f"{k}  {'' if k == 30 else 35}  {60 + k}" for k in range(60)]
    with pytest.raises(RecordError, match="line 32: values are missing, or too many: line 1 names 3 columns"):
        parse_record("\n".join(["t u y", *lines]), "log.csv")


def test_a_pv_that_ends_before_mv_begins_is_nothing_to_resample() -> None:
    lines = [f"{k},{'' if k < 40 else 1},{k if k < 30 else ''}" for k in range(60)]
    with pytest.raises(RecordError, match="PV has its last value at 29 s, and a column its first one only at 40 s"):
        parse_record("\n".join(["t,u,y", *lines]), "log.csv", ReadOptions(resample_s=1.0))


def test_nothing_to_resample() -> None:
    for text in ("t,u,y\n0,Bad,Bad\n1,Bad,Bad\n", "t,u,y\n0,1,Bad\n1,1,2\n"):
        with pytest.raises(RecordError, match="there is nothing to resample"):
            parse_record(text, "log.csv", ReadOptions(resample_s=1.0))


@pytest.mark.parametrize(("text", "s"), [("5s", 5.0), ("500 ms", 0.5), ("1,5", 1.5), ("2min", 120.0), ("1 h", 3600.0)])
def test_durations(text: str, s: float) -> None:
    assert duration(text) == s


@pytest.mark.parametrize("text", ["", "s", "0s", "-5s", "5 days", "nan", "1,000ms"])
def test_what_is_no_duration(text: str) -> None:
    with pytest.raises(ValueError, match="a time such as 5s"):
        duration(text)


def test_columns_that_may_be_swapped() -> None:
    t, u, y = open_loop(FIRST_ORDER, step())
    relay = np.where(np.sin(t) > 0.0, 5.0, -5.0)
    answer = np.cumsum(relay) + np.random.default_rng(1).normal(size=len(t))
    for mv, pv, swapped in ((u, y, False), (y, u, True), (relay, answer, False), (answer, relay, True)):
        assert may_be_swapped(Record(t, mv, pv)) is swapped
    noise = np.random.default_rng(2).normal(size=(2, len(t)))
    assert not may_be_swapped(Record(t, noise[0], noise[1])) and not may_be_swapped(Record(t, u, u))
