"""The ME-PSO rule on the paper's fifteen problems and on models of any scale."""

from __future__ import annotations

from typing import Any

import pytest

from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.complex_criterion import Weighting
from loopwright.tuning.rules.me_pso import me_pso
from loopwright.tuning.rules.setting import Setting
from tests.unit.tuning.search_tables import HORIZON_S, ME_PSO, PLANTS

BEST: dict[str, dict[str, dict[str, Any]]] = ME_PSO["recomputed"]["best_found"]
DOMAINS: dict[str, dict[str, list[float]]] = ME_PSO["printed"]["domains"]


def as_published(plant: str, weighting: str, optimiser: str) -> Setting:
    domain = DOMAINS[plant]
    return me_pso(
        PLANTS[plant],
        weighting=weighting,
        optimiser=optimiser,
        Ms_max=0.0,
        horizon_s=HORIZON_S[plant],
        Kp_max=domain["Kp"][1],
        Ki_min=1.0 / domain["Ti"][1],
    )


@pytest.mark.parametrize("weighting", Weighting)
@pytest.mark.parametrize("plant", PLANTS)
def test_the_swarm_on_the_paper_s_problems(plant: str, weighting: Weighting) -> None:
    found, best = as_published(plant, weighting, "me-pso").chosen, BEST[plant][weighting[0].upper()]
    assert found["evaluations"] == 2500
    # the printed settings are not optimal in any of the problems; on duration the swarm stops short of the best too
    assert found["criterion"] < best["criterion_at_printed_ME_PSO"]
    if weighting is not Weighting.DURATION:
        assert found["criterion"] < 1.01 * best["criterion"]


@pytest.mark.parametrize("weighting", Weighting)
@pytest.mark.parametrize("plant", PLANTS)
def test_nelder_mead_on_the_paper_s_problems(plant: str, weighting: Weighting) -> None:
    found, best = as_published(plant, weighting, "nelder-mead"), BEST[plant][weighting[0].upper()]
    assert found.chosen["evaluations"] <= 2500
    assert found.chosen["criterion"] < (1.03 if weighting is Weighting.DURATION else 1.01) * best["criterion"]
    if weighting is Weighting.ERROR:
        assert found.gains.Kp == pytest.approx(best["Kp"], rel=0.01)
        # the paper's Ti is the reciprocal of the integral gain
        assert found.gains.Ti == pytest.approx(best["Kp"] * best["Ti"], rel=0.01)
        assert found.chosen["overshoot_pct"] == pytest.approx(best["overshoot_pct"], abs=0.2)
        assert found.chosen["settling_s"] == pytest.approx(best["ts"], rel=0.01)


@pytest.mark.parametrize("weighting", Weighting)
@pytest.mark.parametrize("plant", ["G4", "G5"])
def test_differential_evolution_on_the_paper_s_problems(plant: str, weighting: Weighting) -> None:
    found, best = as_published(plant, weighting, "de").chosen, BEST[plant][weighting[0].upper()]
    assert found["evaluations"] <= 2500
    assert found["criterion"] < 1.01 * best["criterion"]


def test_the_control_weighting_wants_a_pure_integral_controller_and_says_so() -> None:
    found = as_published("G2", "control", "nelder-mead")
    assert found.gains.Kp == pytest.approx(1e-4, rel=0.1)
    assert any("pure integral" in note for note in found.notes)


@pytest.mark.parametrize("plant", ["G2", "G5"])
def test_the_bound_on_Ms_holds_unless_it_is_lifted(plant: str) -> None:
    bound, free = me_pso(PLANTS[plant]), as_published(plant, "error", "me-pso")
    assert margins(PLANTS[plant], bound.gains).Ms < 2.02
    assert margins(PLANTS[plant], free.gains).Ms > 2.9
    assert not any("not robust" in note for note in bound.notes)
    assert any("not robust" in note for note in free.notes)
    assert free.chosen["criterion"] < bound.chosen["criterion"]


@pytest.mark.parametrize("optimiser", ["me-pso", "de", "nelder-mead"])
def test_the_same_seed_gives_the_same_gains(optimiser: str) -> None:
    model = FOPDT(2.0, 5.0, 2.5)
    first, again = (me_pso(model, optimiser=optimiser, seed=4) for _ in range(2))
    other = me_pso(model, optimiser=optimiser, seed=5)
    assert first == again
    assert other.gains != first.gains
    assert other.chosen["criterion"] == pytest.approx(first.chosen["criterion"], rel=0.02)


@pytest.mark.parametrize(("gain", "time"), [(-1.0, 1.0), (40.0, 1.0), (1.0, 600.0), (-0.03, 0.02)])
def test_gains_follow_the_scale_of_the_plant(gain: float, time: float) -> None:
    plain = me_pso(FOPDT(1.0, 2.0, 1.0))
    scaled = me_pso(FOPDT(gain, 2.0 * time, time))
    assert scaled.gains.Kp == pytest.approx(plain.gains.Kp / abs(gain), rel=1e-3)
    assert scaled.gains.Ti == pytest.approx(plain.gains.Ti * time, rel=1e-3)
    assert scaled.chosen["settling_s"] == pytest.approx(plain.chosen["settling_s"] * time, rel=1e-3)


@pytest.mark.parametrize(
    "model",
    [
        FOPDT(2.0, 50.0, 0.5),
        FOPDT(2.0, 0.5, 5.0),
        SOPDT(-0.5, 3.0, 0.4, 1.0),
        SOPDT(1.0, 3.0, 2.0, 0.0),
        Integrating(0.05, 4.0),
        Integrating(0.05, 0.0, 4.0),
        TransferFunction((1.0, 4.0), (3.0, 1.0)),
    ],
)
def test_every_kind_of_model_gets_a_stable_robust_loop(model: Model) -> None:
    found = me_pso(model)
    assert found.gains.Kp > 0.0
    assert found.gains.Ti > 0.0
    assert found.chosen["Ms"] < 2.02
    assert found.chosen["settling_s"] < found.chosen["horizon_s"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"weighting": "comfort"}, "error, control, duration"),
        ({"optimiser": "annealing"}, "me-pso, de, nelder-mead"),
        ({"Ms_max": 0.9}, "above 1"),
        ({"Ms_max": float("nan")}, "above 1"),
        ({"horizon_s": -1.0}, "horizon_s"),
        ({"horizon_s": 0.1}, "at least 2.5 s"),
        ({"seed": -1}, "not negative"),
        ({"seed": 0.5}, "whole number"),
        ({"Kp_max": 0.0}, "Kp_max"),
        ({"Kp_max": 1e-9}, "above 5e-05 is accepted"),
        ({"Ki_min": float("inf")}, "Ki_min"),
        ({"Ki_min": 1e9}, "below"),
    ],
)
def test_bad_arguments_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(Refused, match=said) as refused:
        me_pso(FOPDT(2.0, 5.0, 1.0), **options)
    assert refused.value.reason is Reason.BAD_INPUT


def test_a_horizon_too_short_to_settle_is_said() -> None:
    found = me_pso(FOPDT(2.0, 5.0, 2.5), horizon_s=3.0)
    assert any("by the end of the horizon" in note for note in found.notes)


def test_a_domain_without_a_stable_loop_is_refused() -> None:
    # an integral gain so high that nothing in the domain is stable
    with pytest.raises(Refused, match="no stable loop") as refused:
        me_pso(FOPDT(1.0, 1.0, 5.0), Ki_min=20.0)
    assert refused.value.reason is Reason.NOT_ROBUST


def test_the_setting_is_a_plain_pi() -> None:
    found = me_pso(FOPDT(2.0, 5.0, 2.5), optimiser="nelder-mead")
    assert found.gains == Gains(found.gains.Kp, found.gains.Ti)
