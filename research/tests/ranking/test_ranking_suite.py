"""The suite that policies are ranked on: what its generator draws."""

from __future__ import annotations

from collections import Counter

import numpy as np

from research.ranking.suite import MISSIONS, NEWEST, TROUBLES, further_text, name_of, suite_text
from sortie.scenarios.reading.load import condition_sets, load_conditions, read
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.experiment import rank
from sortie.sim.experiment.conditions import scenario_of


def held(name: str) -> ConditionSet:
    found = load_conditions(name)
    assert found is not None
    return found


def test_the_generator_gives_the_suites_file_and_a_released_one_never_changes() -> None:
    name = name_of(NEWEST)
    assert name in condition_sets()
    assert read(name)[0] == suite_text(NEWEST)
    assert rank.digest_of("ranking_v1") == "4d7e931438a5"


def test_the_suite_crosses_troubles_and_missions_and_draws_all_else() -> None:
    suite = rank.load_suite("ranking_v1")
    names = [c.name for c in suite.conditions]
    assert names == [f"{mission}_{trouble}" for mission in MISSIONS for trouble in TROUBLES]
    flown = [scenario_of(suite, c, "all-4") for c in suite.conditions]
    assert Counter(s.fleet.drones for s in flown) == {4: 10, 5: 10, 6: 10}
    assert len({s.perception.scene.seed for s in flown}) == len({s.seed for s in flown}) == 30
    budgets = np.sort(np.log([c.budget for c in suite.conditions]))
    assert np.diff(budgets).max() < 2 * np.log(100) / 30, "spread evenly: one in each thirtieth of the range"
    for condition, scenario in zip(suite.conditions, flown, strict=True):
        mission, _, trouble = condition.name.partition("_")
        assert (condition.metric == "mission") == (mission != "search")
        assert len(scenario.events) == (trouble not in ("clear", "weak", "tired"))
        assert (scenario.fleet.battery.initial_soc < 0.3) == (trouble == "tired")
        assert scenario.policy.invariants.count("\n") == 1


def test_further_draws_are_of_the_same_kinds_and_share_no_town_with_the_suite() -> None:
    suite, more = rank.load_suite("ranking_v1"), list(held("ranking_v1_further").conditions[:60])
    assert [c.name for c in more] == [f"{c.name}_{k}" for k in (1, 2) for c in suite.conditions]
    assert [c.metric for c in more] == [c.metric for c in suite.conditions] * 2
    towns = [o for c in (*suite.conditions, *more) for o in c.set if o.startswith("perception.scene.seed=")]
    assert len(set(towns)) == 90
    assert read("ranking_v1_further")[0] == further_text(NEWEST)
    wide = suite.model_copy(update={"conditions": tuple(more)})
    assert scenario_of(wide, more[0], "all-4").perception.detector == "surrogate"
