"""Every entry builds, rests, and its facts are true of its model."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.plantsim.catalogue import CATALOGUE, CatalogueModel, Entry, find
from loopwright.plantsim.own_plant import own_plant

LINEAR = [(entry, entry.model) for entry in CATALOGUE.values() if entry.model is not None]
BY_NAME = pytest.mark.parametrize(("entry", "model"), LINEAR, ids=[entry.name for entry, _ in LINEAR])


@pytest.mark.parametrize("name", list(CATALOGUE))
def test_builds_and_rests(name: str) -> None:
    entry = find(name)
    plant = entry.build(0.1, 0.0, 1)
    for _ in range(50):
        pv = plant.step(entry.facts.mv_nominal_pct)
    assert pv == pytest.approx(entry.facts.pv_nominal, abs=1e-9)


@BY_NAME
def test_ultimate_point(entry: Entry, model: CatalogueModel) -> None:
    facts = entry.facts
    assert facts.Ku is not None and facts.Pu_s is not None
    s = 2j * np.pi / facts.Pu_s
    response = np.polyval(model.num, s) / np.polyval(model.den, s) * np.exp(-s * model.dead_time_s)
    loop = facts.Ku * response * (1 if facts.reverse else -1)
    assert loop == pytest.approx(-1, abs=1.5e-3)


@BY_NAME
def test_gain_and_settling_time(entry: Entry, model: CatalogueModel) -> None:
    facts = entry.facts
    if facts.static_gain is None or facts.T95_s is None:
        assert model.den[-1] == 0
        return
    assert model.num[-1] / model.den[-1] == facts.static_gain
    plant = entry.build(0.1)
    samples = round(3 * facts.T95_s / 0.1)
    y = np.array([plant.step(facts.mv_nominal_pct + 10) for _ in range(samples)]) - facts.pv_nominal
    outside = np.abs(y / (0.1 * facts.static_gain) - 1) > 0.05
    assert (np.nonzero(outside)[0].max() + 2) * 0.1 == pytest.approx(facts.T95_s, abs=0.21)


def test_all_fifty_and_the_gain_on_the_bus() -> None:
    assert {f"model-{k}" for k in range(1, 51)} <= set(CATALOGUE)
    assert find("model-14").facts.Ku_on_bus == pytest.approx(205.0)
    assert find("reactor").facts.Ku_on_bus == pytest.approx(1.5294)


def test_seeds_make_equal_runs() -> None:
    for name in ("model-14", "reactor"):
        runs = [[find(name).build(0.1, 0.1, seed).pv, find(name).build(0.1, 0.1, seed).step(50)] for seed in (1, 1, 2)]
        assert runs[0] == runs[1]
        assert runs[0] != runs[2]


def test_an_unknown_name_is_told_what_there_is() -> None:
    with pytest.raises(KeyError, match="reactor"):
        find("model-51")


def test_a_second_path_does_again_later_what_the_first_one_did() -> None:
    once = own_plant('{"num": [2], "den": [3, 1], "dead_time_s": 1}').build(0.1)
    twice = own_plant('{"num": [2], "den": [3, 1], "dead_time_s": 1, "second_path": {"share": 0.4, "later_s": 5}}')
    both = twice.build(0.1)
    first = [once.step(51.0) - 50.0 for _ in range(200)]
    seen = [both.step(51.0) - 50.0 for _ in range(200)]
    assert seen[:50] == pytest.approx(first[:50])
    assert seen[50:] == pytest.approx([a + 0.4 * b for a, b in zip(first[50:], first, strict=False)])


@pytest.mark.parametrize("path", ['{"share": 0.4}', "3", '{"share": 0.4, "later_s": -1}'])
def test_a_second_path_that_is_none_is_refused(path: str) -> None:
    with pytest.raises(ValueError, match=r"second_path is a JSON object|later_s is"):
        own_plant(f'{{"num": [2], "den": [3, 1], "second_path": {path}}}')
