"""One record as twelve systems write it: two steps of MV on a heater, sampled every 5 s; or the heater in automatic.

The forms are those that the systems' manuals and their users' files show; the record is our own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial

import numpy as np
from scipy.signal import lfilter

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.plan import Mode

TS, SAMPLES = 5.0, 300
K, T, L = 0.8, 120.0, 15.0
"""The heater: degC per %, s, s."""
NOISE = 0.05
FINE = 0.5
"""Sampling of the simulation, s."""
KP, TI = 4.0, 100.0
"""The controller of the heater: % per degC, s."""
OPERATED, SETPOINTS = 900, (0.0, 2.0, 0.5, 2.5, 1.0)
"""Samples of the heater in automatic, and its set-points in turn, degC above 60."""


@dataclass(frozen=True)
class Sample:
    """A line of the record. t: s. mv: %. pv and sp: degC."""

    t: float
    mv: float
    pv: float
    sp: float = 62.0


@dataclass(frozen=True)
class ExportedFile:
    """A file as a system writes it. system: which kind of system. arguments: what `identify` is to be given with it.
    repaired: whether samples of it are missing or come at other times than in the others."""

    system: str
    content: bytes
    arguments: tuple[str, ...] = ()
    repaired: bool = False


def _mv(t: float) -> float:
    return 35.0 if t < 125.0 else 41.0 if t < 800.0 else 32.0


def _recorded() -> tuple[list[Sample], list[Sample]]:
    """The record every 5 s, and at uneven times: 1 to 3 s apart, and whenever MV moves."""
    plant = LinearPlant([K], [T, 1.0], L, FINE, mv_low=-100.0, mv_high=100.0)
    noise = np.random.default_rng(11)
    even: list[Sample] = []
    uneven: list[Sample] = []
    times, due = np.random.default_rng(7), 0.0
    for k in range(int(SAMPLES * TS / FINE)):
        t = k * FINE
        sample = Sample(t, _mv(t), round(60.0 + plant.pv + NOISE * noise.standard_normal(), 2))
        if k % int(TS / FINE) == 0:
            even.append(sample)
        if t >= due or sample.mv != uneven[-1].mv:
            uneven.append(sample)
            due = t + float(times.uniform(1.0, 3.0))
        plant.step(_mv(t) - 35.0)
    return even, uneven


def operated(load: float) -> tuple[list[Sample], list[Sample]]:
    """The heater in automatic, whose operators move SP four times, in the same two samplings.

    load: standard deviation of a load that wanders, %.
    """
    plant = LinearPlant([K], [T, 1.0], L, FINE, mv_low=-100.0, mv_high=100.0)
    settings = Settings(mv_low=-100.0, mv_high=100.0)
    channel = Channel(TS, settings, Parameters(KP, TI), 60.0, int(Mode.AUTOMATIC), 35.0)
    random = np.random.default_rng(5)
    wandering = lfilter([1.0], [1.0, -0.99], random.standard_normal(OPERATED))
    wandering *= load / wandering.std()
    even: list[Sample] = []
    uneven: list[Sample] = []
    due, each, mv = 0.0, int(TS / FINE), 35.0
    for k in range(OPERATED * each):
        t = k * FINE
        pv = 60.0 + plant.pv + NOISE * random.standard_normal()
        if k % each == 0:
            channel.setpoint = 60.0 + SETPOINTS[k // each * len(SETPOINTS) // OPERATED]
            mv = channel.step(pv)
            even.append(Sample(t, mv, pv, channel.setpoint))
        if t >= due or mv != uneven[-1].mv:
            uneven.append(Sample(t, mv, pv, channel.setpoint))
            due = t + float(random.uniform(1.0, 3.0))
        plant.disturbance = wandering[k // each]
        plant.step(mv - 35.0)
    return even, uneven


_START = datetime(2026, 11, 25, 10, 0, 0, tzinfo=UTC)


def _moments(form: str, start: datetime = _START) -> Callable[[Sample], str]:
    return lambda sample: (start + timedelta(seconds=sample.t)).strftime(form)


def _comma(value: float) -> str:
    return f"{value:.2f}".replace(".", ",")


def _text(*above: str, lines: Callable[[Sample], str], of: Sequence[Sample], end: str = "\n") -> str:
    return end.join([*above, *map(lines, of)]) + end


def _iso(sample: Sample) -> str:
    return (_START + timedelta(seconds=sample.t)).isoformat(timespec="milliseconds")


def _logger(record: Sequence[Sample]) -> str:
    """A data logger: a title, date and time apart, a line of units, values and lines missing, a line at the end."""
    when = _moments("%d-%m-%Y,%H:%M:%S")
    lines = []
    for k, each in enumerate(record):
        if k in (100, 101, 230):
            continue
        pv = "Bad" if k in (40, 41, 210) else f"{each.pv:.2f}"
        lines.append(f"{when(each)},{each.mv:.1f},{pv},{each.sp:.1f}")
    above = ["Logger 7, unit 3", "Group: Heater", "", "Date,Time,Output,Measurement,Setpoint", ",,%,degC,degC"]
    return "\r\n".join([*above, *lines, "EOF"]) + "\r\n"


def files_of(record: Sequence[Sample], uneven: Sequence[Sample]) -> dict[str, ExportedFile]:
    """The files of a record, which comes every 5 s and at uneven times, by the name of the system."""
    text = partial(_text, of=record)
    day_first, us = _moments("%d.%m.%Y %H:%M:%S"), _moments("%m/%d/%Y %I:%M:%S %p", _START.replace(hour=11, minute=50))
    quoted = _moments("%m/%d/%Y %H:%M:%S")
    archive = _moments("%d/%m/%Y %H:%M:%S", datetime(2026, 5, 4, 23, 50, tzinfo=UTC))
    named = _moments("%d-%b-%y %H:%M:%S.0")
    scada = _moments("%Y/%m/%d %H:%M:%S")
    analyst = _moments("%d/%m/%Y %H:%M:%S", datetime(2026, 2, 1, 23, 55, tzinfo=UTC))
    return {
        "plain": ExportedFile("a script", text("t,u,y", lines=lambda s: f"{s.t:g},{s.mv:g},{s.pv}").encode()),
        "spreadsheet": ExportedFile(
            "a spreadsheet with decimal comma",
            text(
                "Zeit;Stellwert (%);Istwert (°C)",
                lines=lambda s: f"{day_first(s)};{_comma(s.mv)};{_comma(s.pv)}", end="\r\n",
            ).encode("cp1252"),
            ("--t", "Zeit", "--u", "Stellwert (%)", "--y", "Istwert (°C)"),
        ),
        "scada": ExportedFile(
            "a SCADA system in UTF-16",
            text(
                "Timestamp\tTIC101.SP\tTIC101.PV\tTIC101.OP",
                lines=lambda s: f"{scada(s)}\t{_comma(s.sp)}\t{_comma(s.pv)}\t{_comma(s.mv)}", end="\r\n",
            ).encode("utf-16"),
        ),
        "dcs": ExportedFile(
            "a control system, month first, over noon",
            text(
                "Date/Time,CO (%),PV (degC),Comment", lines=lambda s: f"{us(s)},{s.mv:.3f},{s.pv:.3f},", end="\r\n"
            ).encode("utf-8-sig"),
        ),
        "trend": ExportedFile(
            "a trend tool with three header lines",
            text(
                '" ","5RT101 op","5RT101 pv"', '" ","%","DEG C"', '"Derived va","R5101 REAC","R5101 REAC"',
                lines=lambda s: f'"{quoted(s)}", {s.mv:g}, {s.pv:g}',
            ).encode(),
        ),
        "analyst": ExportedFile(
            "a process analyst: ms apart, day first over the end of a day",
            text(
                "Time\tMilliseconds\tPane1-OP\tPane1-PV", lines=lambda s: f"{analyst(s)}\t0\t{s.mv:g}\t{s.pv:g}"
            ).encode(),
        ),
        "archive": ExportedFile(
            "a SCADA archive with descriptions and a separator at the end",
            text(
                "Timestamp; F101.OP; F101.PV;", "; Valve; Temperature;",
                lines=lambda s: f"{archive(s)}; {s.mv:g}; {s.pv:g};",
            ).encode(),
        ),
        "gateway": ExportedFile(
            "an SQL historian with qualities",
            text(
                "t_stamp,tic101/op,tic101/op_q,tic101/pv,tic101/pv_q",
                lines=lambda s: f'"{_iso(s)}",{s.mv:.4f},192,{s.pv:.4f},192',
            ).encode(),
        ),
        "database": ExportedFile(
            "a time series database: ms since 1970",
            text(
                "time,mv,pv", lines=lambda s: f"{int((_START.timestamp() + s.t) * 1000)},{s.mv!r},{s.pv!r}"
            ).encode(),
        ),
        "historian": ExportedFile(
            "a historian: month by name, latest first",
            text(
                "TIMESTAMP,TIC101.CO,TIC101.PV", lines=lambda s: f"{named(s).upper()},{s.mv:.2f},{s.pv:.2f}",
                of=record[::-1],
            ).encode(),
        ),
        "logger": ExportedFile("a data logger with values missing", _logger(record).encode(), repaired=True),
        "uneven": ExportedFile(
            "a recorder without an even clock",
            text("time,op,pv", lines=lambda s: f"{s.t:.1f},{s.mv:g},{s.pv:g}", of=uneven).encode(),
            ("--resample", "5s"),
            repaired=True,
        ),
    }  # fmt: skip


FILES = files_of(*_recorded())
