"""Who wins where: planted truths, rules and thresholds, and intervals that are widened for all that is compared."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from campaign_examples import CAMPAIGN, rows_of

from sortie.scenarios.intervals import LEVEL, mean_interval
from sortie.sim.experiment.rows import CampaignRows, sign, winner_metrics
from sortie.sim.experiment.winners import _best, _first, other_winners, rule, winner
from sortie.sim.results.outcome import possible

NAN = math.nan
AP = "ap50.mission"
SOC = "fleet.battery.initial_soc"
SECOND = "best-2(received_budget=0.1)"
DRAWS = CAMPAIGN.replace("  fleet.formation.spacing_m: {kind: grid, values: [20, 40]}\n", "")
DRAWS = DRAWS.replace("replications: 2", "replications: 1").replace("{count: 6}", "{count: 80}")


def test_a_planted_flip_is_found_with_its_threshold(tmp_path: Path) -> None:
    """Policy 0 wins by 1 above a charge of 0.4, policy 1 by 1 below: three quarters of the draws are above."""
    noise = np.random.default_rng(3).normal(0, 0.3, 10_000).tolist()

    def value(fields: dict[str, float], policy: int) -> float:
        gain = 1 if fields[SOC] > 0.4 else -1
        return -(fields[SOC] * 50 + gain * (policy == 0) + noise.pop())  # bytes: less is better

    rows = rows_of(tmp_path, DRAWS, value)
    assert winner(rows, "bytes.data_sent") == "worked"
    (found,) = other_winners(rows, "bytes.data_sent")
    assert (found.field, found.winner, found.sure) == (SOC, SECOND, True)
    assert found.part.startswith("0.2")
    made = rule(rows, "bytes.data_sent")
    assert made is not None
    assert (made.field, made.below, made.above) == (SOC, SECOND, "worked")
    assert made.threshold == pytest.approx(0.4, abs=0.03)
    assert made.gain.low > 0


def test_where_nothing_flips_no_rule_gains(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    rows = rows_of(tmp_path, DRAWS, lambda f, p: p + rng.normal(0, 0.1))
    assert other_winners(rows, "bytes.data_sent") == []
    made = rule(rows, "bytes.data_sent")
    assert made is None or made.gain.low <= 0


def test_a_rule_over_a_grid_is_judged_on_other_draws(tmp_path: Path) -> None:
    """Policy 0 wins by 1 at 20 m, policy 1 at 40 m: worth 1 over the best fixed policy, and sure of it over draws."""
    rng = np.random.default_rng(7)

    def value(fields: dict[str, float], policy: int) -> float:
        return -(1.0 if (fields["fleet.formation.spacing_m"] == 20) == (policy == 0) else -1.0) + rng.normal(0, 0.01)

    made = rule(rows_of(tmp_path, CAMPAIGN.replace("{count: 6}", "{count: 40}"), value), "bytes.data_sent")
    assert made is not None
    assert (made.field, made.threshold, made.below, made.above) == ("fleet.formation.spacing_m", 30.0, "worked", SECOND)
    assert made.gain.mean == pytest.approx(1.0, abs=0.01)
    assert made.gain.count == 40, "draws, not cells"


def test_a_rule_and_the_fixed_policy_that_it_is_compared_with_are_chosen_on_the_same_half(tmp_path: Path) -> None:
    """Policy 0 leads in even draws, policy 1 in odd ones: each half chooses one policy for all, and gains nothing."""
    runs = iter(range(1000))

    def value(fields: dict[str, float], policy: int) -> float:
        lead = (0.3 if next(runs) // 2 % 2 == 0 else -0.3) + (0.2 if fields[SOC] > 0.6 else -0.2)
        return -lead * (policy == 0)  # bytes: less is better

    made = rule(rows_of(tmp_path, DRAWS.replace("{count: 80}", "{count: 40}"), value), "bytes.data_sent")
    assert made is not None
    assert (made.below, made.above) == (SECOND, "worked")
    assert (made.gain.low, made.gain.mean, made.gain.high, made.gain.count) == (0.0, 0.0, 0.0, 40)


WORSE_OR_BETTER = {
    **dict.fromkeys(("ap50.mission", "phases.1.ap50.full_scene", "bytes.data_delivered", "drones.0.soc"), 1),
    **dict.fromkeys(("battery.3", "payload_fates.delivered"), 1),
    **dict.fromkeys(("ap50.scored_fusions", "ap50.sample_rate_hz", "policies.changes", "duration_s"), 0),
    **dict.fromkeys(("bytes.data_sent", "energy_j.total", "drones.0.energy_j", "deadline_miss_rate"), -1),
    **dict.fromkeys(("phases.0.deadline_miss_rate", "policies.invariant_violations", "distrusted_by.2"), -1),
    **dict.fromkeys(("policies.shield_interventions", "age_s.p99", "payload_fates.expired/deadline_queued"), -1),
}


def test_what_is_better_of_a_metric_and_by_which_a_winner_is_told() -> None:
    assert {metric: sign(metric) for metric in WORSE_OR_BETTER} == WORSE_OR_BETTER
    assert winner_metrics(["bytes.data_sent", "phases.0.ap50.mission"]) == ["phases.0.ap50.mission"]
    assert winner_metrics(["policies.changes", "ap50.scored_fusions", "energy_j.total"]) == ["energy_j.total"]
    assert winner_metrics(["policies.changes"]) == []


Value = tuple[int, int, int, int, float | None, str]
"""Unit, grid point, replication, policy, value and status of a run."""


def rows(values: list[Value], field: dict[int, float] | None = None) -> CampaignRows:
    """Rows at one grid point, in one replication; a field's value follows from the unit."""
    units, policies = 1 + max(v[0] for v in values), 1 + max(v[3] for v in values)
    made = pa.Table.from_pylist(
        [
            {"unit": u, "cell": u, AP: v, "status": s, "x": float(u) if field is None else field[u]}
            for u, _, _, _, v, s in values
        ]
    )
    plan = SimpleNamespace(policies=["a", "b", "c"][:policies], grid=[{}], cells=units, units=units)
    plan.campaign = SimpleNamespace(vary=["x"])
    return CampaignRows(plan, made, made["unit"].to_numpy(), np.array([v[3] for v in values]))  # type: ignore[arg-type]


def test_a_rule_found_on_every_second_unit_is_judged_on_the_others() -> None:
    """Policy a has 1 below 16 and 0 above, policy b the reverse; the units with an odd number have failed.

    On 0, 4, … the threshold is 14: of 2, 6, 10, 14 and so on it gets the 14 wrong. On 2, 6, … it is 16, and all of
    0, 4, … are right. Over a, the best fixed policy of either half, the gains are 0, 0, 0, −1, 1, 1, 1, 1 and
    0, 0, 0, 0, 1, 1, 1, 1.
    """
    done: list[Value] = [(u, 0, 0, p, float((u < 16) != p), "done") for u in range(0, 32, 2) for p in range(2)]
    failed: list[Value] = [(u, 0, 0, p, None, "failed") for u in range(1, 32, 2) for p in range(2)]
    made = rows(sorted(done + failed, key=lambda v: (v[0], v[3])))
    found = rule(made, AP)
    assert found is not None
    assert (found.field, found.threshold, found.below, found.above) == ("x", 15.0, "a", "b")
    gains = [0.0, 0.0, 0.0, -1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    assert found.gain == mean_interval(gains, possible(AP).of_differences())


def test_a_threshold_leaves_an_eighth_on_either_side_and_who_has_no_value_is_never_first() -> None:
    """Of 32 cells b is better in the first two, or in the last four alone."""
    x = {"x": np.arange(32.0)}
    low = np.column_stack([np.zeros(32), np.where(np.arange(32) < 2, 10.0, -1.0)])
    high = np.column_stack([np.zeros(32), np.where(np.arange(32) >= 28, 1.0, -1.0)])
    assert _best(x, low) == ("x", 3.5, 1, 0)
    assert _best(x, high) == ("x", 27.5, 0, 1)
    assert _first(np.array([[1.0, 2.5, NAN], [1.0, 0.0, NAN]])) == 1
    assert _first(np.array([[-1.0, NAN], [-2.0, NAN]])) == 0


def test_another_winner_s_interval_is_widened_for_all_parts_and_all_others() -> None:
    """Three policies in two parts: four comparisons."""
    best = {(0, 0): 0.9, (0, 1): 0.1, (0, 2): 0.2, (1, 0): 0.5, (1, 1): 0.6, (1, 2): 0.3}
    off = (0.0, 0.01, 0.03, 0.02)
    values = [
        (u, 0, 0, p, best[u % 2, p] + (off[u // 2] if p == 1 else 0.0), "done") for u in range(8) for p in range(3)
    ]
    made = rows(values, field={u: float(u % 2) for u in range(8)})
    (found,) = other_winners(made, AP)
    assert (found.field, found.part, found.winner) == ("x", "1", "b")
    gains = [0.1 + each for each in off]
    wanted = mean_interval(gains, possible(AP).of_differences(), 1 - (1 - LEVEL) / 4)
    assert (found.gain.low, found.gain.high) == pytest.approx((wanted.low, wanted.high))
    assert found.sure


MISSES = CAMPAIGN.replace("metrics: [bytes.data_sent, energy_j.total]", "metrics: [deadline_miss_rate]").replace(
    "policies: [", "policies: [silence, "
)


def test_a_rule_is_between_the_policies_that_have_values(tmp_path: Path) -> None:
    def misses(fields: dict[str, float], policy: int) -> float | None:
        return None if policy == 0 else 0.2 + 0.1 * ((fields[SOC] > 0.6) == (policy == 1))

    found = rule(rows_of(tmp_path, MISSES, misses, "deadline_miss_rate"), "deadline_miss_rate")
    assert found is not None
    assert (found.below, found.above) == ("worked", SECOND)
