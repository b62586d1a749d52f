"""Files as people have them that mislead a reader: each is read as it is meant, or the command asks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.cli.main import app
from loopwright.service.offline.automatic import in_automatic
from loopwright.service.offline.csv_record.errors import RecordError
from loopwright.service.offline.csv_record.record import ReadOptions, Record, load_record, parse_record
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.identify import Identified, identify
from loopwright.tuning.models import FOPDT
from loopwright.tuning.operation.export import action_of
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Refused

K, T, L, SAMPLES, MOVED = 0.8, 20.0, 3.0, 200, 20
"""A heater: degC per %, s, s; MV goes from 50 to 60 % at that sample."""


def pv(t: float) -> float:
    return 20.0 + (10.0 * K * (1.0 - math.exp(-(t - MOVED - L) / T)) if t > MOVED + L else 0.0)


def mv(t: float) -> float:
    return 50.0 if t < MOVED else 60.0


Line = Callable[[float], str]


def lines(line: Line) -> str:
    return "".join(line(float(t)) + "\n" for t in range(SAMPLES))


def semicolons(t: float) -> str:
    return f"{t:g};{mv(t):g};{pv(t):.4f}".replace(".", ",")


def plain(t: float) -> str:
    return f"{t:g},{mv(t):g},{pv(t):.4f}"


def read(text: str, **options: object) -> Record:
    return parse_record(text, "log.csv", ReadOptions(**options))  # type: ignore[arg-type]


def error_of(text: str, **options: object) -> str:
    with pytest.raises(RecordError) as caught:
        read(text, **options)
    return str(caught.value)


def identified(record: Record) -> Identified:
    return identify(record.t, record.u, record.y, record.u_before)


def is_the_heater(record: Record, Ts: float = 1.0, per_on: float = 1.0) -> bool:
    """Whether the record is that of the heater, sampled every Ts; per_on: % that MV moves where it is switched on."""
    times = np.arange(float(SAMPLES))
    pvs, mvs = np.array([pv(t) for t in times]), np.array([mv(t) for t in times])
    read_mv = record.u if per_on == 1.0 else 50.0 + per_on * record.u
    assert record.t - record.t[0] == pytest.approx(Ts * times, rel=1e-6)
    return bool(np.allclose(record.y, pvs, atol=6e-4) and np.allclose(read_mv, mvs))


NUMBERED = {"t": "1", "u": "2", "y": "3"}


@pytest.mark.parametrize(
    "line",
    [
        lambda t: f"{t:g},  {mv(t):g},  {pv(t):.3f}",
        lambda t: f"{t:g} , {mv(t):g} , {pv(t):.3f}",
        lambda t: f"{t:g};  {mv(t):g},0;  {pv(t):.3f}".replace(".", ","),
        lambda t: f"{t:g},0   {mv(t):g},0   {pv(t):.4f}".replace(".", ","),
        lambda t: f"{t:g}|{mv(t):g}|{pv(t):.3f}",
    ],
    ids=["comma and blanks", "blanks about commas", "semicolon and blanks", "blanks and decimal commas", "bars"],
)
def test_the_sign_between_the_cells_is_the_one_that_leaves_numbers(line: Line) -> None:
    record = read(lines(line), columns=NUMBERED)
    assert is_the_heater(record) and record.names == {"u": "column 2", "y": "column 3"}


@pytest.mark.parametrize("step", [500, 250, 50, 100_000])
def test_times_without_a_unit_that_cannot_well_be_s_are_asked_for(step: int) -> None:
    text = "t,u,y\n" + lines(lambda t: f"{t * step:.0f},{mv(t):g},{pv(t):.4f}")
    assert f"t has no unit; as s its values come every {step:.4g} s" in error_of(text)
    assert is_the_heater(read(text, time_unit="ms"), Ts=step / 1000.0)
    assert is_the_heater(read(text, time_unit="s"), Ts=float(step))


@pytest.mark.parametrize("step", [1, 20, 60, 300, 3600])
def test_times_that_may_well_be_s_are_s(step: int) -> None:
    text = "t,u,y\n" + "".join(f"{k * step},1,{k}\n" for k in range(100))
    assert read(text).t[-1] == 99.0 * step


def test_a_record_of_weeks_is_questioned() -> None:
    text = "time{},u,y\n" + "".join(f"{k * 3600},1,{k}\n" for k in range(400))
    assert "every 3600 s, 16.6 d in all. Say which unit it is: --time-unit ms" in error_of(text.format(""))
    assert "The record is 16.6 d long by time (s) in s: check the unit" in read(text.format(" (s)")).notes[0]


def test_a_unit_is_given_for_numbers_alone() -> None:
    text = "t,u,y\n2026-11-25 10:00:00,1,2\n2026-11-25 10:00:05,1,2\n"
    assert "--time-unit is for times that are numbers; t has '2026-11-25 10:00:00'" in error_of(text, time_unit="ms")


@pytest.mark.parametrize(
    ("header", "line", "columns"),
    [
        ("u,y\n", lambda t: f"{mv(t):g},{pv(t):.4f}", {}),
        ("", lambda t: f"{mv(t):g};{pv(t):.4f}".replace(".", ","), {"u": "1", "y": "2"}),
        ("Remark;PV;MV\n", lambda t: f"ok;{pv(t):.4f};{mv(t):g}", {}),
    ],
)
def test_a_file_without_times(header: str, line: Line, columns: dict[str, str]) -> None:
    text = header + lines(line)
    assert "--every 1s" in error_of(text, columns=columns)
    assert is_the_heater(read(text, columns=columns, every_s=0.1), Ts=0.1)


@pytest.mark.parametrize(
    ("on", "off"),
    [
        ("on", "off"), ("TRUE", "FALSE"), ("EIN", "AUS"), ("an", "aus"), ("Marche", "Arrêt"), ("Vrai", "Faux"),
        ("encendido", "apagado"), ("Sí", "No"), (" Yes ", " No "), ("wahr", "falsch"),
    ],
)  # fmt: skip
def test_mv_in_words(on: str, off: str) -> None:
    record = read("t;u;y\n" + lines(lambda t: f"{t:g};{on if mv(t) == 60.0 else off};{pv(t):.4f}"))
    assert is_the_heater(record, per_on=10.0)
    assert record.notes[0] == f"u was read as a number: {off.strip()!r} as 0, {on.strip()!r} as 1."


def test_words_that_mean_either_are_no_numbers() -> None:
    text = "t,u,y\n" + lines(lambda t: f"{t:g},{'open' if mv(t) == 60.0 else 'closed'},{pv(t):.4f}")
    assert "such as 'closed', first in lines 2, 3, 4, 5, 6: write numbers, such as 1 for open" in error_of(text)


@pytest.mark.parametrize("first", ["0,0,20", "2026-11-25 10:00:00,0,20"])
def test_a_first_time_that_is_there_twice_is_that_of_the_move(first: str) -> None:
    time = (lambda t: f"2026-11-25 10:{int(t) // 60:02}:{int(t) % 60:02}") if "-" in first else (lambda t: f"{t:g}")
    answer = lines(lambda t: f"{time(t)},50,{20.0 + 5.0 * (pv(t + MOVED) - 20.0):.4f}")
    record = read(f"t,u,y\n{first}\n" + answer)
    model = identified(record).model
    assert isinstance(model, FOPDT)
    assert pytest.approx((K, T, L), rel=0.01) == (model.K, model.T, model.L)
    assert record.u_before == 0.0 and "Line 2 was left out: line 3 has the same time" in record.notes[-1]


def test_a_move_that_is_logged_before_and_after() -> None:
    before, after = lines(plain).split("\n")[:MOVED], lines(plain).split("\n")[MOVED:]
    text = "\n".join(["t,u,y", *before, f"{MOVED},50,20", *after])
    record = read(text)
    assert is_the_heater(record) and record.u_before is None
    assert "Line 22 was left out: line 23 has the same time, and its values hold" in record.notes[-1]


def test_values_of_one_time_in_two_lines_are_put_together() -> None:
    text = "t,u,y\n" + lines(lambda t: f"{t:g},{mv(t):g},\n{t:g},,{pv(t):.4f}")
    assert is_the_heater(read(text))


def test_other_values_of_the_same_time_are_named_with_a_way_out() -> None:
    two = "t,u,y\n" + lines(plain) + "199,60,9\n"
    assert "line 202: the time does not increase" in error_of(two) and "delete one of them" in error_of(two)
    halves = "t,u,y\n" + lines(lambda t: f"{t // 2:g},{mv(t):g},{pv(t):.4f}")
    assert "if they come evenly: --every 0.5s" in error_of(halves)
    assert is_the_heater(read(halves, every_s=0.5), Ts=0.5)


@pytest.mark.parametrize(
    "header",
    [
        "Time,Input,Output", "t,input,output", "Time,Output,Input", "t,u_in,y_out", "Zeit,Eingang,Ausgang",
        "temps,entrée,sortie", "tiempo,entrada,salida", "t,Plant input,Plant output", "Time,Input (%),Output (degC)",
    ],
)  # fmt: skip
def test_input_and_output_may_be_the_plants_or_the_controllers(header: str) -> None:
    text = header + "\n" + lines(plain)
    assert "may be those of the plant or of the controller. Say which is MV: --u" in error_of(text)
    first, second = header.split(",")[1:]
    record = read(text, columns={"u": first, "y": second})
    assert is_the_heater(record)


def test_an_output_alone_is_that_of_the_controller() -> None:
    assert is_the_heater(read("Time,Output,PV\n" + lines(plain)))
    assert "Input and Output may be" in error_of("Time,Setpoint,Input,Output\n" + lines(lambda t: plain(t) + ",1"))


K_SPICE = (
    "Export of case 7\nModel: Train, Time: 10:00\nTime: absolute, rate: 1\n\nTag-names,LIC1.OP,LIC1.PV\nUnits,%,m\n"
)
LABVIEW = (
    "LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\tOne\nTime\t10:00:00.1\n***End_of_Header***\t\n\t\n"
    "Channels\t2\t\t\nSamples\t200\t200\t\nDate\t2026/11/25\t2026/11/25\t\nX0\t0.0\t0.0\t\nDelta_X\t1.0\t1.0\t\n"
    "***End_of_Header***\t\t\t\nX_Value\tMV\tPV\tComment\n"
)


@pytest.mark.parametrize(
    ("above", "line", "time", "units"),
    [
        (K_SPICE, plain, "1", {"u": "%", "y": "m"}),
        (LABVIEW, lambda t: plain(t).replace(",", "\t") + "\t", "X_Value", {}),
        ("".join(f"Setting {k}: {3 * k}, value {k}\n" for k in range(80)) + "time,op,pv\n", plain, None, {}),
        (
            "Report,,\nDate: 1,,\n,,\nTime,OP,PV\nEinheit,%,bar\nfloat,float,float\n",
            plain,
            None,
            {"u": "%", "y": "bar"},
        ),
        ("sep=;\nZeit;Stellwert;Istwert\n", semicolons, None, {}),
        ("# t,u,y\n", plain, None, {}),
    ],
    ids=[
        "units labelled",
        "settings above",
        "many lines above",
        "units and types",
        "a spreadsheet's sign",
        "in a comment",
    ],
)
def test_the_names_are_in_the_last_wide_line_of_words(
    above: str, line: Line, time: str | None, units: dict[str, str]
) -> None:
    record = read(above + lines(line), columns={} if time is None else {"t": time})
    assert is_the_heater(record) and record.units == units


@pytest.mark.parametrize(
    ("header", "chosen"),
    [
        ("Time,LIC1.PV,LIC1.OP,LIC2.PV,LIC2.OP", "LIC2.PV"),
        ("Time,PV_1,OP_1,PV_2,OP_2", "PV_2"),
        ("t,PV1,MV1,PV2,MV2", "4"),
        ("Time,PV,OP,Time,PV,OP", "5"),
    ],
)
def test_two_loops_side_by_side(header: str, chosen: str) -> None:
    again = header.count("Time") > 1
    text = header + "\n" + lines(lambda t: f"{t:g},{t % 7},30,{f'{t:g},' if again else ''}{pv(t):.4f},{mv(t):g}")
    assert "there are several loops side by side: PV is" in error_of(text)
    assert is_the_heater(read(text, columns={"y": chosen}))


def sent_changes(noise: float, step: float, seed: int) -> str:
    """PV of a slow heater as a sensor sends it that rounds to `step` and sends nothing but changes."""
    random, sent = np.random.default_rng(seed), ["t,u,y"]
    plant = LinearPlant([K], [120.0, 1.0], 15.0, 0.1)
    last = (math.nan, math.nan)
    for k in range(16_000):
        u = 0.0 if k < 1000 else 10.0 if k < 9000 else -5.0
        rounded = (u, round((20.0 + plant.pv + noise * random.standard_normal()) / step) * step)
        if rounded != last:
            sent.append(f"{k / 10.0:g},{u:g},{rounded[1]:.2f}")
            last = rounded
        plant.step(u)
    return "\n".join(sent)


@pytest.mark.parametrize(("noise", "step"), [(0.0, 0.1), (0.01, 0.1), (0.02, 0.05), (0.0, 0.25)])
def test_a_sensor_that_sends_changes_alone_is_held(noise: float, step: float) -> None:
    text = sent_changes(noise, step, seed=3)
    record = read(text, resample_s=5.0)
    assert any(f"PV changes by {step:g} and is not repeated" in note for note in record.notes)
    model = identified(record).model
    assert isinstance(model, FOPDT)
    assert (
        pytest.approx(K, rel=0.02), pytest.approx(120.0, rel=0.03), pytest.approx(15.0, abs=2.5)
    ) == (model.K, model.T, model.L)  # fmt: skip
    straight = read(text, resample_s=5.0, hold=False)
    assert not any("is not repeated" in note for note in straight.notes)
    assert np.any(np.abs(straight.y / step - np.rint(straight.y / step)) > 0.1)


def test_other_sensors_are_held_where_that_is_asked_for() -> None:
    text = "t,u,y\n0,0,0\n1.5,4,3\n4,4,8\n6,4,12\n"
    assert read(text, resample_s=2.0, hold=True).y.tolist() == [0.0, 3.0, 8.0, 12.0]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("Time;Event;User\n" + lines(lambda t: f"2026-11-25 10:00;PV high {t:g};ann"), "line 1 is 'Time;Event;User'"),
        ("t,tag,event,level\n" + lines(lambda t: f"2026-11-25T10:00:00,TIC,HI,{t:g}"), "line 2 has no two numbers"),
        (lines(lambda t: f"2026-11-25 10:00 INFO loop[{t:g}] pv={pv(t)}"), "line 1 is '2026-11-25 10:00 INFO"),
        ("Starting\n" + lines(lambda t: "[1] INFO: reading sensor, value ok"), "line 1 is 'Starting'"),
        ('[{"t": 0, "u": 1, "y": 2},\n{"t": 1, "u": 1, "y": 2}]', "it is JSON"),
        ("<html><table></table></html>", "it is a page"),
    ],
    ids=["events", "events with a number", "log", "log of words", "JSON", "a page"],
)  # fmt: skip
def test_what_is_no_table_of_measurements(text: str, why: str) -> None:
    assert f"is not a table of measurements: {why}" in error_of(text)


@pytest.mark.parametrize(
    ("start", "named"), [(b"PK\x03\x04\x14\x00", "a workbook"), (b"\xd0\xcf\x11\xe0\xa1\xb1", "an old workbook")]
)
def test_a_workbook_is_named(start: bytes, named: str, tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    file.write_bytes(start + bytes(200))
    with pytest.raises(RecordError, match=f"is not a table of measurements as text: it is {named}.* as CSV"):
        load_record(file)


@pytest.mark.parametrize(
    "header",
    [
        "Zeit;Stellwert;Istwert;Sollwert", "Zeit in s;Stellgrad in %;Istwert in °C;Sollwert in °C",
        "Zeit [s];Stellgröße [%];Regelgröße [°C];Führungsgröße [°C]", "temps;commande;mesure;consigne",
        "Temps (s);Sortie régulateur (%);Valeur mesurée (°C);Point de consigne (°C)", "tiempo;salida;medida;consigna",
        "Tiempo (s);Señal de control;Valor medido;Punto de consigna", "TIME;TIC101/OP;TIC101/PV;TIC101/SP",
    ],
)  # fmt: skip
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-16"])
def test_names_in_four_languages(header: str, encoding: str, tmp_path: Path) -> None:
    file = tmp_path / "trend.csv"
    file.write_bytes((header + "\n" + lines(lambda t: semicolons(t) + ";50,0")).encode(encoding))
    record = load_record(file)
    assert record.sp is not None and list(record.names.values()) == header.split(";")[1:]
    assert is_the_heater(record)


def test_signs_that_contradict_each_other_are_asked_for() -> None:
    text = "t;u;y\n" + lines(lambda t: f"{t:g};{mv(t):g},000;1.{t:03.0f}")
    assert "u has '50,000' and y has '1.000': one of the signs separates thousands" in error_of(text)


@pytest.mark.parametrize("unit", [" degC", " °C", " l/min"])
def test_values_with_their_unit_behind_them(unit: str) -> None:
    record = read("t;u;y\n" + lines(lambda t: f"{t:g} s;{mv(t):g} %;{pv(t):.4f}{unit}"))
    assert is_the_heater(record) and record.units["y"] == unit.strip()


def level_loop(b: float, high: float, steps: Sequence[tuple[int, float]]) -> Record:
    """A level under a PI, with a noise that is stored to four digits."""
    plant = LinearPlant([0.02], [1.0, 0.0], 2.0, 1.0, mv_low=-500.0, mv_high=500.0)
    channel = Channel(
        1.0, Settings(mv_low=0.0, mv_high=high), Parameters(6.0, 60.0, b=b), 50.0, int(Mode.AUTOMATIC), 50.0
    )
    random, rows = np.random.default_rng(1), []
    for k in range(600):
        for at, change in steps:
            channel.setpoint = 50.0 + change if k == at else channel.setpoint
        y = 50.0 + plant.pv + 0.02 * random.standard_normal()
        u = channel.step(y)
        rows.append((float(k), round(u, 4), round(y, 4), channel.setpoint))
        plant.step(u - 50.0)
    t, u_, y_, sp = np.array(rows).T
    return Record(t, u_, y_, sp, names={"u": "OP", "y": "PV", "sp": "SP"})


@pytest.mark.parametrize(("b", "high", "change"), [(1.0, 100.0, 10.0), (1.0, 80.0, 8.0), (0.7, 100.0, 15.0)])
def test_op_at_its_limit_bounds_the_set_point_weight(b: float, high: float, change: float) -> None:
    record = level_loop(b, high, [(100, change)])
    found = in_automatic(record)
    assert found is not None and found.control.gains is not None and found.options is not None
    assert (found.control.gains.Kp, found.control.gains.Ti) == (
        pytest.approx(6.0, rel=0.01),
        pytest.approx(60.0, rel=0.03),
    )
    least = (high - 50.0) / (6.0 * change)
    assert found.control.weight_minimum == pytest.approx(least, rel=0.01) and least < b
    assert f"b {found.control.weight_minimum:.2g} or more (OP was at its limit where SP moved)" in found.law
    assert found.options[-2:] == ("--b", "B")
    assert record.sp is not None
    for weight, accepted in ((b, True), (1.0, True), (0.5 * least, False)):
        stretch = Stretch(0.0, 1.0, record.u, record.y, record.sp, Gains(6.0, 60.0, b=weight))
        if accepted:
            assert action_of(stretch)
        else:
            with pytest.raises(Refused, match=r"where SP steps OP moves .* times as far as b .* asks for"):
                action_of(stretch)


def test_one_set_point_step_within_the_limits_fixes_the_weight() -> None:
    found = in_automatic(level_loop(0.7, 100.0, [(100, 15.0), (400, 12.0)]))
    assert found is not None and found.control.weight_minimum is None and found.control.gains is not None
    assert found.control.gains.b == pytest.approx(0.7, rel=0.01)


def test_the_options_of_the_command(tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    file.write_text("u,y\n" + lines(lambda t: f"{mv(t):g},{pv(t):.4f}"))

    def run(*options: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["identify", str(file), *options])
        return result.exit_code, " ".join(result.output.split())

    code, shown = run("--every", "100ms")
    assert code == 0 and "200 samples every 0.1 s" in shown and "K 0.8, T 2 s" in shown
    for options, words in (
        (("--every", "often"), "--every: a time such as 5s, 500ms or 1min is expected, not 'often'"),
        (("--every", "1s", "--t", "1"), "--every and --t exclude each other"),
        (("--time-unit", "weeks"), "--time-unit: one of ns, us, ms, s, min, h and d is expected, not 'weeks'"),
        (("--hold", "--every", "1s"), "give --resample too"),
    ):
        code, shown = run(*options)
        assert code == 2 and words in shown
