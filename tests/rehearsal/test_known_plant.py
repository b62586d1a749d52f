"""Method fast where operation has shown the plant: only the step under the new gains, and what happens where the plant
is another one by now."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import RunResult, run
from loopwright.service.observing.packed_plant import pack, unpack
from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.experiments.primitives import Directions, Facts
from loopwright.tuning.fast.excitation_choice import fast_by
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.fast.known_plant.procedure import TrialFigures
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.procedure import FastOptions, FastProposal
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.means import means_alike
from loopwright.tuning.models import FOPDT, TransferFunction
from loopwright.tuning.operation.history import Stretch
from loopwright.tuning.operation.known import known_plant
from loopwright.tuning.operation.observation import observe
from loopwright.tuning.plan import Event, Mode, Note, Sample, StageDone, StageStarted
from loopwright.tuning.reasons import Reason
from tests.rehearsal.test_observe import ASKED, LAG, NOISE, PI, THIRD, TS, changes, operated

Plant = TransferFunction | FOPDT
BOTH = (Excitation.OBSERVE, Excitation.SETPOINT)
T95_S = 40.0
FROM_OPERATION = [0.8, -0.3, 0.6, 0.0]


@cache
def heard_of(plant: Plant, gains: Gains, together: int = 1) -> ObservedPlant:
    """What operation shows of a plant. together: the number of samples of which the history has means."""
    stretch = operated(plant, gains, changes(FROM_OPERATION, 200.0))
    if together > 1:
        pv, mv, ends = means_alike(np.arange(len(stretch.pv) + 1), stretch.pv, stretch.mv, together)
        sp = stretch.sp[ends[1:-1].astype(int)]
        stretch = Stretch(stretch.t_s, together * TS, mv, pv, sp, gains, held_s=TS)
    known = known_plant(observe([stretch], plant.static_gain > 0.0, ASKED), TS, 60.0)
    assert isinstance(known, ObservedPlant), known
    return known


class Retuned:
    """A loop at rest that is retuned by fast, and what was reported of that."""

    def __init__(
        self,
        plant: Plant,
        gains: Gains,
        known: ObservedPlant | NothingKnown,
        excitations: tuple[Excitation, ...] = BOTH,
        directions: Directions = Directions.BOTH,
        sp_rate_max_per_s: float = math.inf,
        **options: bool,
    ) -> None:
        self.stages: list[str] = []
        self.notes: list[str] = []
        self.trials: list[TrialFigures] = []
        self.taken: list[Sample] = []
        self.plant = plant
        reverse = plant.static_gain > 0.0
        process = LinearPlant(plant.num, plant.den, plant.L, TS, noise_std=NOISE, seed=11)
        settings = Settings(mv_low=-50.0, mv_high=50.0, pv_low=-1e9, pv_high=1e9, reverse=reverse)
        channel = Channel(TS, settings, Parameters(gains.Kp, gains.Ti), 0.0, int(Mode.AUTOMATIC), 0.0)
        facts = Facts(
            TS, T95_S, -50.0, 50.0, 1.0, gains, reverse, directions=directions, sp_rate_max_per_s=sp_rate_max_per_s
        )
        asked = FastOptions(propose_anyway=True, **options)
        self.ended: RunResult[FastProposal] = run(
            fast_by(excitations, facts, asked, known),
            RehearsedLoop(process, channel, TS),
            limits=RunLimits(-100.0, 100.0, -50.0, 50.0, max_time_s=100 * T95_S),
            on_event=self._hear,
            on_samples=self.taken.extend,
        )

    def _hear(self, event: Event) -> None:
        if isinstance(event, StageStarted):
            self.stages.append(event.stage)
        elif isinstance(event, Note):
            self.notes.append(event.text)
        elif isinstance(event, StageDone) and isinstance(event.result, TrialFigures):
            self.trials.append(event.result)

    @property
    def proposal(self) -> FastProposal:
        assert self.ended.value is not None, (self.ended.ended, self.notes)
        return self.ended.value

    @property
    def true_Ms(self) -> float:
        sampled = TransferFunction(self.plant.num, self.plant.den, self.plant.L + 0.5 * TS)
        return margins(sampled, self.proposal.gains).Ms

    @property
    def moved_for_s(self) -> float:
        """Plant time from the first move of the set-point, s."""
        first = next(i for i in range(1, len(self.taken)) if self.taken[i].sp != self.taken[i - 1].sp)
        return (len(self.taken) - first) * TS


@cache
def moved_by_pulses_for_s(plant: Plant, gains: Gains) -> float:
    return Retuned(plant, gains, NothingKnown("-"), (Excitation.SETPOINT,)).moved_for_s


@pytest.mark.parametrize("together", [1, 3])
@pytest.mark.parametrize(("plant", "gains"), [(LAG, PI), (THIRD, Gains(0.5, 12.0))])
def test_of_a_known_plant_only_the_new_gains_are_tried(plant: Plant, gains: Gains, together: int) -> None:
    known = heard_of(plant, gains, together)
    found = Retuned(plant, gains, known)
    assert found.true_Ms == pytest.approx(1.6, abs=0.05)
    assert found.stages == ["preflight", "design", "trial", "redesign"] and found.notes == []
    assert {sample.mode for sample in found.taken} == {int(Mode.AUTOMATIC)}
    assert found.proposal.model_from == f"{known.source}, and the step under the new gains"
    assert "set-point changes of normal operation" in known.source
    trial = found.trials[0]
    assert trial.outdated is None and trial.step == 1.0
    assert trial.gain is not None and trial.gain_error is not None
    assert abs(trial.gain - 1.0) < 4.0 * trial.gain_error + 0.01
    verified = found.proposal.verified
    assert verified is not None and verified.fit_pct > 90.0
    assert found.moved_for_s < moved_by_pulses_for_s(plant, gains)


def test_new_gains_take_over_without_a_bump() -> None:
    found = Retuned(LAG, PI, heard_of(LAG, PI))
    at = next(i for i in range(1, len(found.taken)) if found.taken[i].sp != found.taken[i - 1].sp)
    moved = found.taken[at].mv - found.taken[at - 1].mv
    tested = found.trials[0].tested
    assert moved == pytest.approx(tested.b * tested.Kp * 1.0, abs=8.0 * NOISE * tested.Kp)


@pytest.mark.parametrize(
    "changed",
    [
        replace(LAG, K=2.0 * LAG.K), replace(LAG, K=0.5 * LAG.K),
        replace(LAG, L=LAG.L + 1.1), replace(LAG, L=LAG.L + 3.0), replace(LAG, T=2.0 * LAG.T),
    ],
    ids=["gain doubled", "gain halved", "dead time 0.1 Pu longer", "0.3 Pu longer", "slower"],
)  # fmt: skip
def test_a_plant_that_has_changed_is_found_and_pulses_follow(changed: FOPDT) -> None:
    found = Retuned(changed, PI, heard_of(LAG, PI))
    assert found.true_Ms == pytest.approx(1.6, abs=0.1)
    outdated = found.trials[0].outdated
    assert outdated is not None and outdated in found.notes[-1] + "".join(found.notes)
    assert any("the trial of gains from operation failed" in note and "pulses" in note for note in found.notes)
    at = found.stages.index("trial")
    assert found.stages[at + 1] == "settle" and "pulses" in found.stages[at:]
    assert found.proposal.model_from == "pulses of the set-point, and the set-point step under the new gains"


def test_the_size_of_the_change_is_said() -> None:
    trial = Retuned(replace(LAG, K=1.1 * LAG.K), PI, heard_of(LAG, PI)).trials[0]
    assert trial.outdated is not None and "times that of operation" in trial.outdated
    assert trial.gain == pytest.approx(1.1, abs=0.03)


def test_an_unstable_trial_is_ended_early_and_the_present_gains_take_over() -> None:
    found = Retuned(replace(LAG, K=4.0 * LAG.K), Gains(0.2, 9.0), heard_of(LAG, Gains(0.2, 9.0)))
    assert found.trials[0].outdated is not None
    assert max(abs(sample.pv) for sample in found.taken) < 3.0, "2 steps, and what is on its way by then"
    assert found.true_Ms == pytest.approx(1.6, abs=0.1)


def test_where_nothing_else_is_permitted_it_is_refused() -> None:
    found = Retuned(replace(LAG, K=2.0 * LAG.K), PI, heard_of(LAG, PI), (Excitation.OBSERVE,))
    ended = found.ended.ended
    assert ended is not None and ended.reason is Reason.MODEL_MISMATCH
    assert "no other excitation is permitted" in ended.detail
    nothing = Retuned(LAG, PI, NothingKnown("no set-point change has been heard yet"), (Excitation.OBSERVE,))
    ended = nothing.ended.ended
    assert ended is not None and ended.reason is Reason.UNCERTAIN and "no set-point change" in ended.detail
    assert not nothing.taken, "nothing is waited for"


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        ({"gains": Gains(1.1, 9.0)}, "the gains in effect (Kp 1, Ti 9 s) are not those"),
        ({"age_s": 1e6}, "the latest set-point change is 1e+06 s old; at most 8.64e+04 s"),
        ({"pv": (3.0, 4.0)}, "PV rests at "),
        ({"mv": (3.0, 4.0)}, "MV rests at "),
        ({"together": 2}, "the sample time is 0.2 s, and was 0.1 s"),
    ],
)
def test_what_is_known_of_another_time_place_or_gains_is_not_used(spoilt: dict[str, object], said: str) -> None:
    found = Retuned(LAG, PI, replace(heard_of(LAG, PI), **spoilt))  # type: ignore[arg-type]
    assert "trial" not in found.stages and "pulses" in found.stages
    assert said in found.notes[0]
    assert found.true_Ms == pytest.approx(1.6, abs=0.05)


def test_without_the_step_gains_from_operation_are_not_proposed() -> None:
    found = Retuned(LAG, PI, heard_of(LAG, PI), verify=False)
    assert "trial" not in found.stages and "verify: false" in found.notes[0]


def test_what_was_known_is_the_same_after_it_was_stored() -> None:
    known = heard_of(LAG, PI, together=3)
    again = unpack(pack(known))
    assert isinstance(again, ObservedPlant)
    one, other = Retuned(LAG, PI, known).proposal, Retuned(LAG, PI, again).proposal
    assert one.gains == other.gains and one.model_from == other.model_from
    assert unpack(pack(NothingKnown("why"))) == NothingKnown("why")
    assert isinstance(unpack(b"damaged"), NothingKnown)


class TestDownByRamps:
    """The set-point goes down by a permitted step in one ultimate period of the plant as it was observed."""

    def rehearsed(self, part: float = 1.0) -> Retuned:
        """part: of that rate."""
        self.rate = part / ultimate_point(LAG)[1]
        return Retuned(LAG, PI, heard_of(LAG, PI), directions=Directions.DOWN, sp_rate_max_per_s=self.rate)

    def check_moves(self, found: Retuned) -> None:
        sp = np.array([sample.sp for sample in found.taken])
        assert sp.max() == 0.0 and -1.0 - 1e-9 <= sp.min() < 0.0 and sp[-1] == 0.0
        assert np.abs(np.diff(sp)).max() <= self.rate * TS * (1.0 + 1e-6)

    def test_only_the_new_gains_are_tried(self) -> None:
        found = self.rehearsed()
        assert found.stages == ["preflight", "design", "trial", "redesign"]
        assert found.true_Ms == pytest.approx(1.6, abs=0.05)
        assert found.trials[0].step == -1.0 and found.trials[0].outdated is None
        self.check_moves(found)

    def test_where_ramps_would_show_nothing_the_loop_is_not_moved(self) -> None:
        found = self.rehearsed(0.01)
        assert "trial" not in found.stages
        assert any("a rate of" in note and "at least is needed" in note for note in found.notes)
        assert found.ended.ended is not None and found.ended.ended.reason is Reason.UNCERTAIN
        assert {sample.sp for sample in found.taken} == {0.0}
