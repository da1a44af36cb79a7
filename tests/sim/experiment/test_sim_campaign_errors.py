"""What a campaign's file may not say, at its line; and which metrics it may name."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from campaign_examples import BASE, CAMPAIGN, plan, write

from sortie.policies.contract import PolicyError
from sortie.scenarios.reading.campaign import load_campaign
from sortie.scenarios.reading.load import ScenarioError
from sortie.sim.experiment.flight import scenario_of_task
from sortie.sim.folders import RunError
from sortie.sim.results.outcome import OutcomeDict

SPACING = "fleet.formation.spacing_m:"
GRID = "{kind: grid, values: [20, 40]}"
OWN_SEED = "must be left to the campaign: its own seed decides every run's"
TO_THE_END = "must be left to policies: one other than the base's own flies to the end"
ONE_OF_ITS_FIELDS = "must be one of its fields, as in policy.params.rho"
NO_CAMPAIGN = "must be a scenario, it is a campaign itself"
NO_PHASE = "mission.phases.3: no such entry, mission.phases has 0 … 0"
WRONG = [
    ("fleet.battery.initial_soc:", "fleet.batery.soc:", "5: fleet.batery: unknown key, did you mean battery?"),
    ("initial_soc:", "soc:", "5: fleet.battery.soc: unknown key, did you mean initial_soc?"),
    ("kind: uniform", "kind: gaussian", '5: vary.fleet.battery.initial_soc.kind: "gaussian", must be uniform, '),
    ("high: 1}", "high: 1.5}", "5: fleet.battery.initial_soc: 1.5, must be ≤ 1"),
    ("low: 0.2", "low: 2", "5: vary.fleet.battery.initial_soc.low: 2, must be below high = 1"),
    ("low: 0.2", "lo: 0.2", "5: vary.fleet.battery.initial_soc.low: missing, must be given (and 1 more)"),
    ("values: [20, 40]", "values: [20, -1]", "6: fleet.formation.spacing_m: -1, must be > 0"),
    ("count: 6", "count: 6, method: sobol", "7: sample.count: 6, must be a power of two where method is sobol"),
    ("count: 6", "count: 6, method: morris", "7: sample.method: morris, must be another, or every field of vary drawn"),
    ("policies: [worked,", "policies: [worked, worked,", "9: policies.1: worked, must be named once"),
    ("seed: 5", "stop_when: {metric: x, half_width: 1}", "11: stop_when.metric: x, must be one of metrics"),
    ("seed: 5", "vry: 5", "11: vry: unknown key, did you mean vary?"),
    (SPACING, "seed:", f"6: vary.seed: seed, {OWN_SEED}"),
    ("seed: 5", "set: {seed: 7}", f"11: set.seed: seed, {OWN_SEED}"),
    (SPACING, "policy.name:", "6: vary.policy.name: policy.name, must be left to policies, which lists those that fly"),
    (SPACING, "policy.changes.0.at_s:", f"6: vary.policy.changes.0.at_s: policy.changes.0.at_s, {TO_THE_END}"),
    (SPACING, "policy.commands:", f"6: vary.policy.commands: policy.commands, {TO_THE_END}"),
    (SPACING, "policy:", f"6: vary.policy: policy, {ONE_OF_ITS_FIELDS}"),
    (SPACING, "policy.params:", f"6: vary.policy.params: policy.params, {ONE_OF_ITS_FIELDS}"),
    (GRID, "{kind: column, file: no.csv, column: a}", "6: {here}/no.csv: no such file"),
    (GRID, "{kind: column, file: some.csv, column: b}", "6: {here}/some.csv: no column b, it has a"),
    (
        GRID,
        "{kind: column, file: odd.csv, column: a}",
        "6: fleet.formation.spacing_m: 1_0, must be a number (odd.csv: ",
    ),
    ("base: base.yaml", "base: basse.yaml", "3: base: {here}/basse.yaml: no such file, did you mean base.yaml?"),
    ("base: base.yaml", "base: small_ones.yaml", f"3: base: small_ones.yaml, {NO_CAMPAIGN}"),
    ("base: base.yaml", "base: link_battery", f"3: base: link_battery, {NO_CAMPAIGN}"),
    ("base: base.yaml", "base: conditions", "3: base: conditions, must be a scenario, it is a set of conditions"),
    (SPACING, "mission.phases.3.at_s:", f"6: {NO_PHASE}"),
    ("seed: 5", "set: {mission.phases.3.at_s: 2}", f"11: {NO_PHASE}"),
    ("seed: 5", "set: {name.x: 2}", "11: name.x: no such field, name is the value small"),
    ("seed: 5", "set: {fleet.drones: 1}", "11: events.0.drone: 1, must be below fleet.drones = 1"),
    (f"{SPACING} {GRID}", "duration_s: {kind: grid, values: [0.1]}", "6: events.0.at_s: 0.1, must be below duration_s"),
]


def test_what_is_wrong_is_told_at_its_line(tmp_path: Path) -> None:
    (tmp_path / "some.csv").write_text("a\n1\n")
    (tmp_path / "odd.csv").write_text("a\n1_0\n")
    base, wrong = BASE + "events: [{kind: drone_lost, at_s: 0.1, drone: 1}]\n", {}
    for old, new, message in WRONG:
        assert old in CAMPAIGN
        path = write(tmp_path, CAMPAIGN.replace(old, new), base)
        with pytest.raises(ScenarioError) as error:
            load_campaign(path)
        if not str(error.value).startswith(f"{path}:{message.replace('{here}', str(tmp_path))}"):
            wrong[old, new] = str(error.value)
    assert wrong == {}


def test_draws_that_share_values_stop_at_no_interval(tmp_path: Path) -> None:
    must = "must be left out, or another sample.method: its means have no intervals"
    for method in ("morris", "saltelli"):
        text = CAMPAIGN.replace(f"  {SPACING} {GRID}\n", "").replace("{count: 6}", f"{{count: 8, method: {method}}}")
        assert load_campaign(write(tmp_path, text)).campaign.sample.method == method
        path = write(tmp_path, text + "stop_when: {metric: bytes.data_sent, half_width: 1}\n")
        with pytest.raises(ScenarioError) as error:
            load_campaign(path)
        assert str(error.value) == f"{path}:11: stop_when: {method}, {must}"


def test_a_shorter_campaign_leaves_out_what_its_base_does_later(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    events = "".join(f"  - {{kind: drone_lost, at_s: {at_s}, drone: {i}}}\n" for i, at_s in enumerate((2, 8)))
    (tmp_path / "base.yaml").write_text(f"name: base\nduration_s: 9\nevents:\n{events}")
    file = tmp_path / "c.yaml"
    file.write_text("campaign: c\nbase: base.yaml\nset: {duration_s: 5}\npolicies: [worked]\nmetrics: [switches]\n")
    assert [event.at_s for event in load_campaign(file).base.events] == [2.0]
    assert "events: 1 of 2 begin at duration_s = 5 or later, and are left out" in caplog.text
    file.write_text(file.read_text().replace("duration_s: 5", "events.1.at_s: 9"))
    with pytest.raises(ScenarioError, match=r"events.1.at_s: 9, must be below duration_s = 9"):
        load_campaign(file)


# --- metrics --------------------------------------------------------------------------------------------------------

NO_METRIC = [
    ("bytes.nothing", "bytes has no 'nothing', it has context_sent"),
    ("bytes.data_snt", "bytes has no 'data_snt', did you mean data_sent?"),
    ("wall_s", "is wall clock, a metric must follow from the run alone"),
    ("policy", "is text, a metric must be a number"),
    ("bytes", "is a section, a metric must be a number"),
    ("events.0.kind", "is text, a metric must be a number"),
    ("transitions.0.peers", "is a list, a metric must be a number"),
    ("ap50.mission.x", "ap50.mission has no 'x', it is a number"),
    ("energy_j.recorded", "energy_j has no 'recorded', it has rotor, avionics, compute,"),
    ("battery.2", "battery has no '2', it has 0 … 1"),
    ("distrusted_by.2", "distrusted_by has no '2', it has 0 … 1"),
    ("drones.9.soc", "drones has no '9', it has 0 … 1"),
    ("drones.1.sock", "drones.1 has no 'sock', did you mean soc?"),
    ("phases.0.ap50.missio", "phases.0.ap50 has no 'missio', did you mean mission?"),
    ("phases.1.begin_s", "phases has no '1', it has 0 … 0"),
    ("events.x", "events has no 'x', it has entries by number"),
    ("payload_fates.lost", "payload_fates has no 'lost', did you mean lost/fragment_lost?"),
    ("payload_fates.x", "payload_fates has no 'x', it has delivered, delivered/other_feature_space, "),
    ("descriptor_drops.forgd", "descriptor_drops has no 'forgd', did you mean forged?"),
    ("policies.decisions.workd", "policies.decisions has no 'workd', did you mean worked?"),
]


def test_a_metric_that_is_none_is_refused(tmp_path: Path) -> None:
    wrong = {}
    for name, message in NO_METRIC:
        with pytest.raises(RunError) as error:
            plan(tmp_path, CAMPAIGN.replace("bytes.data_sent", name))
        if not str(error.value).startswith(f"{tmp_path / 'small_ones.yaml'}:10: metrics.0: {name}: {message}"):
            wrong[name] = str(error.value)
    assert wrong == {}


SOME_RUNS_HAVE = (
    "battery.3, drones.3.soc, distrusted_by.3, phases.1.begin_s, energy_j.recorded, policies.decisions.silence, "
    "events.7.t_s, transitions.5.peers.1, payload_fates.lost/no_link, payload_fates.delivered/other_feature_space, "
    "payload_fates.partial/deadline_queued, descriptor_drops.forged, ap50.mission, drones.0.airborne"
)


def test_a_metric_that_only_some_runs_have_is_kept(tmp_path: Path) -> None:
    """By the largest fleet, the longest mission, the traces and the policies of any run; null in the others."""
    (tmp_path / "a.csv").write_text("t_s,drone,soc\n0,0,0.5\n")
    base = BASE + "mission: {phases: [{at_s: 0, phase: search}, {at_s: 1, phase: track}]}\n"
    vary = "fleet.drones: {kind: grid, values: [2, 4]}\n  duration_s: {kind: grid, values: [0.5, 2]}\n"
    text = CAMPAIGN.replace(f"{SPACING} {GRID}", vary + "  fleet.trace: {kind: grid, values: [a.csv, null]}")
    text = text.replace("bytes.data_sent", SOME_RUNS_HAVE).replace('"best-2(received_budget=0.1)"', "silence")
    assert "battery.3" in plan(tmp_path, text, base).campaign.metrics
    short = text.replace("duration_s: {kind: grid", "context.publish_every: {kind: grid").replace("0.5, 2", "1, 2")
    with pytest.raises(RunError, match="phases has no '1', it has 0 … 0"):  # no run is that long
        plan(tmp_path, short, base)


def test_a_metric_that_a_run_does_not_have_is_null_and_a_count_is_zero() -> None:
    """Means over the runs that have one would leave out all those in which nothing was lost."""
    result = {
        **{"a": {"b": 2, "c": None, "d": math.inf}, "phases": [{"x": True}], "battery": {"0": 1.0}},
        **{"payload_fates": {"delivered": 3}, "policies": {"decisions": {"worked": 4}}},
        **{"distrusted_by": {}, "descriptor_drops": {}},
    }
    wanted = {"a.b": 2.0, "a.c": None, "a.d": None, "a.e": None, "phases.0.x": 1.0, "phases.1.x": None}
    wanted |= {"payload_fates.delivered": 3.0, "payload_fates.lost/no_link": 0.0, "policies.decisions.silence": 0.0}
    wanted |= {"distrusted_by.0": 0.0, "descriptor_drops.forged": 0.0, "distrusted_by.7": None}  # there is no drone 7
    assert {name: OutcomeDict(result).number(name) for name in wanted} == wanted


# --- policies -------------------------------------------------------------------------------------------------------

BUDGETS = CAMPAIGN.replace(f"{SPACING} {GRID}", "policy.params.rho: {kind: grid, values: [0.1, 0.2]}")
BUDGETS = BUDGETS.replace('"best-2(received_budget=0.1)"', "deputies(k=1)")
OWN_RHO = "deputies(k=1, rho=0.5) has its own policy.params.rho, which is varied; leave it out here"
CANNOT_FLY = [
    ("deputies(k=1)", "silence", "6: vary.policy.params.rho: policy 'silence' has no parameter 'rho', it has: none"),
    ("params.rho:", "params.roh:", "6: vary.policy.params.roh: policy 'worked' has no parameter 'roh', it has: rho"),
    ("deputies(k=1)", '"deputies(k=1, rho=0.5)"', f"9: policies.1: {OWN_RHO}"),
    ("deputies(k=1)", "wurst-2", "9: policies.1: unknown policy 'wurst-2', did you mean worst-2? known: worked, "),
    ("deputies(k=1)", "deputies(q=1)", "9: policies.1: policy 'deputies' has no parameter 'q', it has: k, rho"),
    ("deputies(k=1)", "deputies(k)", "9: policies.1: policy 'deputies(k)': 'k' in the bracket, must be key=value"),
    ("policies: [worked, deputies(k=1)]", "set: {policy.name: wirkt}", "3: base: unknown policy 'wirkt', known: "),
]


def test_a_policys_parameter_is_varied_for_each_of_them(tmp_path: Path) -> None:
    """Over what the base and the policy's own brackets say; all else that they say stays."""
    p = plan(tmp_path, BUDGETS, BASE + "policy: {name: worked, params: {rho: 0.3}, dwell_s: 2}\n")
    for run in range(p.runs):
        at = p.at(run)
        policy, rho = scenario_of_task(p.task(run)).policy, (0.1, 0.2)[at.cell % 2]
        assert p.varied(at.cell)["policy.params.rho"] == rho
        assert policy.name == ("worked", "deputies")[at.policy]
        assert policy.params == ({"rho": rho}, {"k": 1, "rho": rho})[at.policy]
        assert policy.dwell_s == 2
    assert p.task(0).key != p.task(4).key  # the next grid point, not the next replication


def test_a_policy_that_cannot_fly_is_told_at_its_line(tmp_path: Path) -> None:
    wrong = {}
    for old, new, message in CANNOT_FLY:
        assert old in BUDGETS
        with pytest.raises(PolicyError) as error:
            plan(tmp_path, BUDGETS.replace(old, new))
        if not str(error.value).startswith(f"{tmp_path / 'small_ones.yaml'}:{message}"):
            wrong[new] = str(error.value)
    assert wrong == {}
