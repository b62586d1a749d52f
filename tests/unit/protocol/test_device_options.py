"""Options and files of the device processes that cannot be used: status 2 and a sentence, before any bus is opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from loopwright.controller import __main__ as controller
from loopwright.controller.device import ControllerDevice
from loopwright.plantsim import __main__ as plant
from loopwright.plantsim.device import PlantChannel, PlantDevice
from loopwright.plantsim.own_plant import own_plant
from loopwright.protocol import hub
from loopwright.protocol.profile import Abort, Mode, NmtState
from loopwright.protocol.sdo import SdoAbort
from tests.unit.protocol.memory_bus import Wire

BUS = ("--bus", "virtual:never-opened")
PLANT = '{"num": [1], "den": [1, 1]}'


@pytest.fixture(autouse=True)
def _no_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> int:
        raise AssertionError("a device was started")

    for module in (controller, plant):
        monkeypatch.setattr(module, "run_device", refuse)


def refused(main: Any, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    try:
        status = main(options)
    except SystemExit as end:  # argparse's own
        status = end.code
    assert status == 2
    return capsys.readouterr().err


class TestController:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (("--ts", "0"), "a sample time is 0.0001 to 3600 s"),
            (("--ts", "nan"), "a sample time is 0.0001 to 3600 s"),
            (("--ts", "5000"), "a sample time is 0.0001 to 3600 s"),
            (("--sp", "nan"), "values must be finite"),
            (("--sp", "1e39"), "range of a REAL32"),
            (("--kp", "1e39"), "range of a REAL32"),
            (("--node", "0x10"), "have the node-ID 10h (16) both"),
            (("--keep", "/nowhere/kept.json"), "there is no folder /nowhere"),
            (("--channels", "0"), "1 to 199 channels, not 0"),
            (("--channels", "200"), "1 to 199 channels, not 200"),
        ],
    )
    def test_an_option(self, options: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert words in refused(controller.main, capsys, *BUS, *options)

    @pytest.mark.parametrize("direct", ['"no"', "'false'", "0", "[]"])
    def test_an_action_that_is_not_true_or_false(
        self, direct: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        file = tmp_path / "channels.yaml"
        file.write_text(f"- kp: 2\n  direct: {direct}\n")
        assert "it is true or false" in refused(controller.main, capsys, *BUS, "--config", str(file))

    def test_the_mode_off_of_a_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        file = tmp_path / "channels.yaml"
        file.write_text("- mode: off\n")
        made: list[ControllerDevice] = []

        def run(name: str, bus_url: str, make: Any, description: str) -> int:
            bus: Any = Wire().open()
            made.append(make(bus))
            return 0

        monkeypatch.setattr(controller, "run_device", run)
        assert controller.main([*BUS, "--config", str(file)]) == 0
        assert [channel.mode for channel in made[0].channels] == [Mode.OFF]


class TestPlant:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (("--model", PLANT, "--noise", "nan"), "noise is nan"),
            (("--model", PLANT, "--noise", "-1"), "noise is -1"),
            (("--model", PLANT, "--seed", "-1"), "a seed is 0 to 4294967295"),
            (("--model", '{"num": [1, 1, 1], "den": [1, 1]}'), "a plant must be proper"),
            (("--model", '{"num": [1], "den": [1, 1], "dead_time_s": -1}'), "must be finite and not negative"),
            (("--model", '{"num": [1], "den": [1, 1], "dead_time_s": 1e12}'), "more than 10000000 samples"),
            (("--model", '{"num": [1], "den": [1, 1], "pv": 1e39}'), "pv is 1e+39"),
            (("--model", '{"num": [1], "den": [1, 1], "pv": NaN}'), "pv is nan"),
            (("--model", "fopdt", "--node", "32"), "have the node-ID 20h (32) both"),
            (("--model", "fopdt") * 200, "1 to 199 channels, not 200"),
        ],
    )
    def test_an_option(self, options: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert words in refused(plant.main, capsys, *BUS, *options)

    @pytest.mark.parametrize("model", ["5", "{num: [1], den: [1, 1]}", "[fopdt]"])
    def test_a_model_of_a_file_that_is_no_name(
        self, model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        file = tmp_path / "plants.yaml"
        file.write_text(f"- model: {model}\n")
        assert "it is a name, or a JSON object in quotation" in refused(plant.main, capsys, *BUS, "--config", str(file))

    def test_a_file_that_is_not_utf_8(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        file = tmp_path / "plants.yaml"
        file.write_bytes("- model: fopdt\n".encode("utf-16"))
        assert str(file) in refused(plant.main, capsys, *BUS, "--config", str(file))


@pytest.mark.parametrize("port", ["-1", "65536"])
def test_a_port_of_the_hub(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "a port is 0 to 65535" in refused(hub.main, capsys, "--port", port)


def test_a_sample_time_too_short_for_the_dead_time_is_refused_by_the_plant() -> None:
    entry = own_plant('{"num": [1], "den": [1, 1], "dead_time_s": 5000}')
    bus: Any = Wire().open()
    device = PlantDevice(bus, [PlantChannel(entry.build)])
    device.start()
    device.runtime.state = NmtState.PRE_OPERATIONAL
    with pytest.raises(SdoAbort) as refusal:
        device.dictionary.write(0x1006, 0, (100).to_bytes(4, "little"))
    assert refusal.value.code is Abort.INVALID_VALUE
    assert device.sample_time_s == 0.1 and device.dictionary.get("sample_time") == 100_000
