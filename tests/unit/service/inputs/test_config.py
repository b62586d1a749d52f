from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from loopwright.service.cli.demo import loops_yaml
from loopwright.service.inputs.config import ConfigError, load_site, parse_site
from tests.unit.service.fakes import loop_entry


def test_a_good_file(tmp_path: Path) -> None:
    file = tmp_path / "loops.yaml"
    file.write_text(yaml.safe_dump({"loops": [loop_entry(), loop_entry(tag="B", channel=2, plant_node=None)]}))
    loops = load_site(file).loops
    assert list(loops) == ["TIC-101", "B"]
    assert loops["B"].plant_node is None and loops["B"].mv_limits.high == 100.0


def test_the_demo_writes_a_good_file() -> None:
    assert "TIC-101" in parse_site(yaml.safe_load(loops_yaml("socketcan:vcan0")), "demo").loops


def test_every_error_is_listed_at_once() -> None:
    entries = [
        loop_entry(t95_s=-1, colour="red"),
        loop_entry(tag="B", bus="vcan0", channel=2),
        loop_entry(tag="C", pv_limits={"low": 5, "high": 5}, channel=3),
        loop_entry(tag="D", t95_s=float("nan"), controller_node=200, channel=4),
        loop_entry(tag="E", plant_node=32, channel=5),
        loop_entry(tag="F", sp_deviation=60.0, channel=6),
        loop_entry(tag="G", mv_limits={"low": -10, "high": 50}, channel=7),
        {"tag": "H"},
        loop_entry(tag="I", channel=8, test={"excitations": ["relay", "relay"]}),
        loop_entry(tag="J", channel=9, test={"excitations": []}),
        loop_entry(tag="K", channel=10, test={"excitations": ["relays"]}),
        "nonsense",
        loop_entry(tag="L", channel=11, test={"directions": "up"}),
    ]
    with pytest.raises(ConfigError) as caught:
        parse_site({"loops": entries, "extra": 1}, "loops.yaml")
    text = str(caught.value)
    for words in (
        "loops[0].t95_s (TIC-101)", "loops[0].colour (TIC-101)", "socketcan:vcan0",
        "low (5) must be less than high (5)",
        "loops[3].t95_s (D)", "loops[3].controller_node (D)", "are both 32", "twice", "0..100 percent",
        "loops[7].pv_unit (H): it is missing",
        "loops[8].test.excitations (I): relay, relay: each excitation is named once",
        "loops[9].test.excitations (J)", "loops[10].test.excitations.0 (K)", "loops[11]", "extra: unknown name",
        "loops[12].test (L): directions up exclude the relay",
    ):  # fmt: skip
        assert words in text


def test_each_error_has_its_line_and_says_what_is_expected(tmp_path: Path) -> None:
    file = tmp_path / "loops.yaml"
    file.write_text("""\
loop: []
loops:
- &first
  tag: TIC-101
  bus: socketcan:vcan0
  controller_node: 16
  pv_unit: degC
  pv_limits: {low: 0, high: 100}
  t95: 9
  sp_deviation: five
- <<: *first
  tag: TIC 102
  channel: 2.5
  t95_s: -1
  sp_deviation: 1
  test: {excitations: relay,
    directions: sideways}
buses:
  socketcan:vcan1: {at_once: 0, listens: true}
""")
    with pytest.raises(ConfigError) as caught:
        load_site(file)
    assert str(caught.value).splitlines() == [
        f"{file}: 13 errors",
        "  line 1: loop: unknown name; did you mean loops?",
        "  line 3: loops[0].t95_s (TIC-101): it is missing",
        "  line 9: loops[0].t95 (TIC-101): unknown name; did you mean t95_s?",
        "  line 9: loops[1].t95 (TIC 102): unknown name; did you mean t95_s?",
        "  line 10: loops[0].sp_deviation (TIC-101): a number is expected, not 'five'",
        "  line 12: loops[1].tag (TIC 102): 'TIC 102' is not of the form ^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$",
        "  line 13: loops[1].channel (TIC 102): a whole number is expected, not 2.5",
        "  line 14: loops[1].t95_s (TIC 102): a number greater than 0 is expected, not -1",
        "  line 16: loops[1].test.excitations (TIC 102): a list is expected, not 'relay'",
        "  line 17: loops[1].test.directions (TIC 102): 'both', 'up' or 'down' is expected, not 'sideways'",
        "  line 19: buses.socketcan:vcan1: no loop is on this bus; did you mean socketcan:vcan0?",
        "  line 19: buses.socketcan:vcan1.at_once: a number of at least 1 is expected, not 0",
        "  line 19: buses.socketcan:vcan1.listens: unknown name; did you mean listen?",
    ]


def test_two_loops_may_not_share_a_tag_or_a_channel() -> None:
    with pytest.raises(ConfigError) as caught:
        parse_site({"loops": [loop_entry(), loop_entry()]}, "loops.yaml")
    assert len(caught.value.problems) == 2


@pytest.mark.parametrize("text", ["", "loops: {}", "loops: []", "- 1", "loops: [", "\x00"])
def test_not_a_list_of_loops(tmp_path: Path, text: str) -> None:
    file = tmp_path / "loops.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError):
        load_site(file)


def test_a_key_given_twice_is_refused_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "loops.yaml"
    entry = yaml.safe_dump({"loops": [loop_entry()]})
    file.write_text(entry + "  pv_limits: {low: 0, high: 90}\n")
    with pytest.raises(ConfigError, match=r"line \d+, column 3: not YAML: 'pv_limits' is given twice"):
        load_site(file)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load_site(tmp_path / "none.yaml")


def test_buses_say_how_many_of_their_loops_are_tuned_at_once() -> None:
    bus = loop_entry()["bus"]
    site = parse_site({"loops": [loop_entry()], "buses": {bus: {"at_once": 3}}}, "loops.yaml")
    assert site.buses[bus].at_once == 3 and parse_site({"loops": [loop_entry()]}, "loops.yaml").buses == {}
    wrong = {"socketcan:can9": {"at_once": 2}, bus: {"at_once": 0}}
    with pytest.raises(ConfigError) as caught:
        parse_site({"loops": [loop_entry()], "buses": wrong}, "loops.yaml")
    assert len(caught.value.problems) == 2 and "no loop is on this bus" in caught.value.problems[0]
    with pytest.raises(ConfigError, match="mapping"):
        parse_site({"loops": [loop_entry()], "buses": [1]}, "loops.yaml")


@pytest.mark.parametrize(
    "twice",
    [
        "loops: []\nloops: []\n",
        "loops:\n- tag: A\n  mv_limits: {low: 0, high: 50, low: 10}\n",
        "loops:\n- tag: A\n  'tag': B\n",
        "x: &a {low: 1}\ny: &b {high: 2}\nloops:\n- pv_limits:\n    <<: *a\n    <<: *b\n",
        "loops: [{? [tag]\n: 1, tag: B, tag: C}]\n",
    ],
)
def test_a_key_given_twice_is_refused_wherever_it_is(tmp_path: Path, twice: str) -> None:
    file = tmp_path / "loops.yaml"
    file.write_text(twice)
    with pytest.raises(ConfigError, match="given twice"):
        load_site(file)


def test_a_mapping_may_say_otherwise_than_what_it_is_merged_from(tmp_path: Path) -> None:
    """Also where it is merged into another one before it is itself complete."""
    file = tmp_path / "loops.yaml"
    file.write_text(
        yaml.safe_dump({"loops": [loop_entry()]}).replace("- ", "- &one\n  <<: {t95_s: 1, notes: merged}\n  ")
        + "- {<<: *one, tag: B, channel: 2}\n"
    )
    loops = load_site(file).loops
    assert loops["TIC-101"].t95_s == loops["B"].t95_s == 9.0 and loops["B"].notes == "merged"


@pytest.mark.parametrize("text", ["[" * 100_000, "{a: " * 100_000])
def test_nested_beyond_all_reason(tmp_path: Path, text: str) -> None:
    file = tmp_path / "loops.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError):
        load_site(file)
