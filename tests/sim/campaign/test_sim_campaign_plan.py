"""What a campaign flies: draws, grids, seeds, keys; and what is refused before anything flies."""

from __future__ import annotations

import json
import math
from importlib.metadata import version
from pathlib import Path

import pytest
from campaign_examples import BASE, CAMPAIGN, plan, write
from installed_package import installed_package

from sortie.policies.contract import PolicyError
from sortie.scenarios.reading.campaign import load_campaign
from sortie.scenarios.reading.load import ScenarioError
from sortie.sim.campaign import plan as planning
from sortie.sim.campaign.drive import run_campaign
from sortie.sim.campaign.engine import open_engine
from sortie.sim.campaign.plan import CampaignPlan
from sortie.sim.campaign.work import OtherCodeError, fly_batch, number, unpack
from sortie.sim.folders import RunError


def test_every_combination_is_flown_once_and_policies_of_a_scene_share_their_seed(tmp_path: Path) -> None:
    p = plan(tmp_path)
    assert (p.runs, p.cells, p.units, p.shard) == (48, 12, 6, 30)
    at = [p.at(run) for run in range(p.runs)]
    assert len({(a.cell, a.replication, a.policy) for a in at}) == p.runs
    for first, second in zip(at[::2], at[1::2], strict=True):
        assert (first.cell, first.replication) == (second.cell, second.replication)
        a, b = (json.loads(p.task(x.run)) for x in (first, second))
        assert (a["scenario"].pop("policy")["name"], b["scenario"].pop("policy")["name"]) == ("worked", "best-2")
        assert a == b  # nothing else differs: common random numbers
    assert len({p.seed(cell) for cell in range(p.cells)}) == p.cells


def test_a_cells_seed_depends_on_campaign_seed_and_cell_alone(tmp_path: Path) -> None:
    p = plan(tmp_path)
    other = plan(
        tmp_path, CAMPAIGN.replace("replications: 2", "replications: 3").replace("policies: [worked, ", "policies: [")
    )
    assert [p.seed(c) for c in range(12)] == [other.seed(c) for c in range(12)]
    reseeded = plan(tmp_path, CAMPAIGN.replace("seed: 5", "seed: 6"))
    assert all(p.seed(c) != reseeded.seed(c) for c in range(12))


def test_columns_of_one_file_go_together_and_cross_with_the_rest(tmp_path: Path) -> None:
    (tmp_path / "links.csv").write_text("power,sigma\n10,2\n12.5,3\n")
    text = CAMPAIGN.replace(
        "sample:",
        "  radio.tx_power_dbm: {kind: column, file: links.csv, column: power}\n"
        "  radio.shadowing_sigma_db: {kind: column, file: links.csv, column: sigma}\nsample:",
    )
    grid = plan(tmp_path, text).grid
    names = ("fleet.formation.spacing_m", "radio.tx_power_dbm", "radio.shadowing_sigma_db")
    assert [tuple(g[n] for n in names) for g in grid] == [(20, 10, 2), (20, 12.5, 3), (40, 10, 2), (40, 12.5, 3)]


def test_a_linspace_over_whole_numbers_gives_whole_numbers(tmp_path: Path) -> None:
    text = CAMPAIGN.replace(
        "fleet.formation.spacing_m: {kind: grid, values: [20, 40]}",
        "fleet.drones: {kind: linspace, low: 2, high: 4, count: 3}",
    )
    assert [g["fleet.drones"] for g in plan(tmp_path, text).grid] == [2, 3, 4]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("seed: 5", "seed: 6"),
        ("low: 0.2", "low: 0.21"),
        ("received_budget=0.1", "received_budget=0.11"),
        ("energy_j.total", "energy_j.rotor"),
    ],
)
def test_whatever_reaches_the_worker_changes_the_key(tmp_path: Path, old: str, new: str) -> None:
    before, after = plan(tmp_path), plan(tmp_path, CAMPAIGN.replace(old, new))
    changed = [before.key(run) != after.key(run) for run in range(before.runs)]
    assert any(changed)
    assert before.digest != after.digest
    if "budget" in old:
        assert changed == [False, True] * 24  # the other policy's runs are what they were


def test_the_base_the_code_and_a_policys_file_change_the_key(tmp_path: Path) -> None:
    before = plan(tmp_path)
    assert plan(tmp_path, base=BASE.replace("0.5", "0.6")).key(0) != before.key(0)
    assert CampaignPlan({**before.spec, "code": "other"}).key(0) != before.key(0)
    policy = tmp_path / "mine.py"
    text = CAMPAIGN.replace("worked", f"{policy}:decide")
    policy.write_text("def decide(view):\n    return []\n")
    first = plan(tmp_path, text)
    policy.write_text("def decide(view):\n    return [] # otherwise\n")
    assert plan(tmp_path, text).key(0) != first.key(0)


def test_a_module_that_a_policy_imports_is_part_of_what_is_flown(tmp_path: Path) -> None:
    """An edit of it between two halves of a campaign must not put rows of two codes into one table."""
    (tmp_path / "mine.py").write_text("def decide(view):\n    from deep import answer\n    return answer(view)\n")
    (tmp_path / "deep.py").write_text("from deeper import nothing\n\n\ndef answer(view):\n    return nothing()\n")
    (tmp_path / "deeper.py").write_text("def nothing():\n    return []\n")
    text = CAMPAIGN.replace("worked", "'mine.py:decide'")
    before = plan(tmp_path, text)
    assert set(before.spec["files"]) == {str(tmp_path / f"{name}.py") for name in ("mine", "deep", "deeper")}
    with open_engine() as engine:
        run_campaign(before, tmp_path / "out", engine)
    (tmp_path / "deeper.py").write_text("def nothing():\n    return [] # otherwise\n")
    after = plan(tmp_path, text)
    assert after.digest != before.digest
    assert after.key(0) != before.key(0)
    with open_engine() as engine, pytest.raises(RunError, match=r"its files\..*deeper\.py differs"):
        run_campaign(after, tmp_path / "out", engine)


def test_the_plan_survives_its_json(tmp_path: Path) -> None:
    p = plan(tmp_path)
    again = CampaignPlan(json.loads(json.dumps(p.spec)))
    assert again.digest == p.digest
    assert [again.task(r) for r in range(p.runs)] == [p.task(r) for r in range(p.runs)]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fleet.battery.initial_soc:", "fleet.batery.initial_soc:", "5: fleet.batery: unknown key, did you mean battery?"),
        ("initial_soc:", "soc:", "5: fleet.battery.soc: unknown key, did you mean initial_soc?"),
        (
            "kind: uniform", "kind: gaussian",
            '5: vary.fleet.battery.initial_soc.kind: "gaussian", must be uniform, integers, normal, log_normal, '
            "triangular, choice, linspace, grid or column",
        ),
        ("high: 1}", "high: 1.5}", "5: fleet.battery.initial_soc: 1.5, must be ≤ 1"),
        ("low: 0.2", "low: 2", "5: vary.fleet.battery.initial_soc.low: 2, must be below high = 1"),
        ("low: 0.2", "lo: 0.2", "5: vary.fleet.battery.initial_soc.low: missing, must be given (and 1 more)"),
        ("values: [20, 40]", "values: [20, -1]", "6: fleet.formation.spacing_m: -1, must be > 0"),
        ("count: 6", "count: 6, method: sobol", "7: sample.count: 6, must be a power of two where method is sobol"),
        (
            "count: 6", "count: 6, method: morris",
            "7: sample.method: morris, must be another, or every field of vary drawn, none a grid",
        ),
        ("policies: [worked,", "policies: [worked, worked,", "9: policies.1: worked, must be named once"),
        ("seed: 5", "stop_when: {metric: x, half_width: 1}", "11: stop_when.metric: x, must be one of metrics"),
        ("seed: 5", "vry: 5", "11: vry: unknown key, did you mean vary?"),
        (
            "fleet.formation.spacing_m:", "seed:",
            "6: vary.seed: seed, must be left to the campaign: its own seed decides every run's, replications are further "
            "draws",
        ),
        (
            "fleet.formation.spacing_m:", "policy.name:",
            "6: vary.policy.name: policy.name, must be left to policies, which lists those that fly",
        ),
        (
            "fleet.formation.spacing_m:", "policy.changes.0.at_s:",
            "6: vary.policy.changes.0.at_s: policy.changes.0.at_s, must be left to policies: one other than the base's own "
            "flies to the end",
        ),
        (
            "fleet.formation.spacing_m:", "policy.commands:",
            "6: vary.policy.commands: policy.commands, must be left to policies: one other than the base's own flies to "
            "the end",
        ),
        (
            "fleet.formation.spacing_m:", "policy:",
            "6: vary.policy: policy, must be one of its fields, as in policy.params.rho",
        ),
        (
            "fleet.formation.spacing_m:", "policy.params:",
            "6: vary.policy.params: policy.params, must be one of its fields, as in policy.params.rho",
        ),
        (
            "seed: 5", "set: {seed: 7}",
            "11: set.seed: seed, must be left to the campaign: its own seed decides every run's, replications are further "
            "draws",
        ),
        (
            "{kind: grid, values: [20, 40]}", "{kind: column, file: no.csv, column: a}",
            "6: {here}/no.csv: no such file",
        ),
        (
            "{kind: grid, values: [20, 40]}", "{kind: column, file: some.csv, column: b}",
            "6: {here}/some.csv: no column b, it has a",
        ),
        (
            "{kind: grid, values: [20, 40]}", "{kind: column, file: odd.csv, column: a}",
            "6: fleet.formation.spacing_m: 1_0, must be a number (odd.csv: a in row 1)",
        ),
        ("base: base.yaml", "base: basse.yaml", "3: base: {here}/basse.yaml: no such file, did you mean base.yaml?"),
        (
            "base: base.yaml", "base: small_ones.yaml",
            "3: base: small_ones.yaml, must be a scenario, it is a campaign itself",
        ),
        (
            "base: base.yaml", "base: link_battery",
            "3: base: link_battery, must be a scenario, it is a campaign itself",
        ),
        ("base: base.yaml", "base: conditions", "3: base: conditions, must be a scenario, it is a set of conditions"),
        (
            "fleet.formation.spacing_m:", "mission.phases.3.at_s:",
            "6: mission.phases.3: no such entry, mission.phases has 0 … 0",
        ),
        (
            "seed: 5", "set: {mission.phases.3.at_s: 2}",
            "11: mission.phases.3: no such entry, mission.phases has 0 … 0",
        ),
        ("seed: 5", "set: {name.x: 2}", "11: name.x: no such field, name is the value small"),
        ("seed: 5", "set: {fleet.drones: 1}", "11: events.0.drone: 1, must be below fleet.drones = 1"),
        (
            "fleet.formation.spacing_m: {kind: grid, values: [20,", "duration_s: {kind: grid, values: [0.1,",
            "6: events.0.at_s: 0.1, must be below duration_s = 0.1",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_at_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "some.csv").write_text("a\n1\n")
    (tmp_path / "odd.csv").write_text("a\n1_0\n")
    assert old in CAMPAIGN
    path = write(tmp_path, CAMPAIGN.replace(old, new), BASE + "events: [{kind: drone_lost, at_s: 0.1, drone: 1}]\n")
    with pytest.raises(ScenarioError) as error:
        load_campaign(path)
    assert str(error.value) == f"{path}:{message.format(here=tmp_path)}"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("bytes.nothing", "bytes.nothing: bytes has no 'nothing', it has context_sent"),
        ("bytes.data_snt", "bytes.data_snt: bytes has no 'data_snt', did you mean data_sent?"),
        ("wall_s", "wall_s: is wall clock, a metric must follow from the run alone"),
        ("policy", "policy: is text, a metric must be a number"),
        ("bytes", "bytes: is a section, a metric must be a number"),
        ("events.0.kind", "events.0.kind: is text, a metric must be a number"),
        ("transitions.0.peers", "transitions.0.peers: is a list, a metric must be a number"),
        ("ap50.mission.x", "ap50.mission.x: ap50.mission has no 'x', it is a number"),
        ("energy_j.totl", "energy_j.totl: energy_j has no 'totl', did you mean total?"),
        ("energy_j.recorded", "energy_j.recorded: energy_j has no 'recorded', it has rotor, avionics, compute,"),
        ("battery.2", "battery.2: battery has no '2', it has 0 … 1"),
        ("distrusted_by.2", "distrusted_by.2: distrusted_by has no '2', it has 0 … 1"),
        ("drones.9.soc", "drones.9.soc: drones has no '9', it has 0 … 1"),
        ("drones.1.sock", "drones.1.sock: drones.1 has no 'sock', did you mean soc?"),
        ("phases.0.ap50.missio", "phases.0.ap50.missio: phases.0.ap50 has no 'missio', did you mean mission?"),
        ("phases.1.begin_s", "phases.1.begin_s: phases has no '1', it has 0 … 0"),
        ("events.x", "events.x: events has no 'x', it has entries by number"),
        ("payload_fates.lost", "payload_fates.lost: payload_fates has no 'lost', did you mean lost/fragment_lost?"),
        (
            "payload_fates.x",
            "payload_fates.x: payload_fates has no 'x', it has delivered, delivered/other_feature_space, ",
        ),
        ("descriptor_drops.forgd", "descriptor_drops.forgd: descriptor_drops has no 'forgd', did you mean forged?"),
        (
            "policies.decisions.workd",
            "policies.decisions.workd: policies.decisions has no 'workd', did you mean worked?",
        ),
    ],
)
def test_a_metric_that_is_none_is_refused(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(RunError) as error:
        plan(tmp_path, CAMPAIGN.replace("bytes.data_sent", name))
    assert str(error.value).startswith(f"{tmp_path / 'small_ones.yaml'}:10: metrics.0: {message}")


def test_a_metric_that_only_some_runs_have_is_kept(tmp_path: Path) -> None:
    """By the largest fleet, the longest mission, the traces and the policies of any run; null in the others."""
    (tmp_path / "a.csv").write_text("t_s,drone,soc\n0,0,0.5\n")
    base = BASE + "mission: {phases: [{at_s: 0, phase: search}, {at_s: 1, phase: track}]}\n"
    vary = (
        "fleet.drones: {kind: grid, values: [2, 4]}\n  duration_s: {kind: grid, values: [0.5, 2]}\n"
        "  fleet.trace: {kind: grid, values: [a.csv, null]}"
    )
    names = (
        "battery.3, drones.3.soc, distrusted_by.3, phases.1.begin_s, energy_j.recorded, policies.decisions.silence, "
        "events.7.t_s, transitions.5.peers.1, payload_fates.lost/no_link, payload_fates.delivered/other_feature_space, payload_fates.partial/deadline_queued, "
        "descriptor_drops.forged, ap50.mission, drones.0.airborne"
    )
    text = CAMPAIGN.replace("fleet.formation.spacing_m: {kind: grid, values: [20, 40]}", vary)
    text = text.replace("bytes.data_sent", names).replace('"best-2(received_budget=0.1)"', "silence")
    assert "battery.3" in plan(tmp_path, text, base).campaign.metrics
    with pytest.raises(RunError, match="phases has no '1', it has 0 … 0"):  # if no run is that long
        plan(
            tmp_path,
            text.replace("duration_s: {kind: grid", "context.publish_every: {kind: grid").replace("0.5, 2", "1, 2"),
            base,
        )


def test_the_number_of_a_metric_is_null_where_a_run_has_none() -> None:
    result = {"a": {"b": 2, "c": None, "d": math.inf}, "phases": [{"x": True}]}
    names = ("a.b", "a.c", "a.d", "a.e", "phases.0.x", "phases.1.x")
    assert [number(result, name) for name in names] == [2.0, None, None, None, 1.0, None]


def test_a_count_that_a_run_does_not_have_is_zero() -> None:
    """Means over the runs that have one would leave out all those in which nothing was lost."""
    result = {
        "payload_fates": {"delivered": 3},
        "policies": {"decisions": {"worked": 4}},
        "battery": {"0": 1.0},
        "a": {},
    }
    names = (
        "payload_fates.delivered", "payload_fates.lost/no_link", "policies.decisions.silence", "distrusted_by.0",
        "distrusted_by.7", "descriptor_drops.forged", "a.b",
    )  # fmt: skip
    result |= {"distrusted_by": {}, "descriptor_drops": {}}
    assert [number(result, name) for name in names] == [3.0, 0.0, 0.0, 0.0, None, 0.0, None], "there is no drone 7"


BUDGETS = CAMPAIGN.replace(
    "fleet.formation.spacing_m: {kind: grid, values: [20, 40]}", "policy.params.rho: {kind: grid, values: [0.1, 0.2]}"
).replace('"best-2(received_budget=0.1)"', "deputies(k=1)")


def test_a_policys_parameter_is_varied_for_each_of_them(tmp_path: Path) -> None:
    """Over what the base and the policy's own brackets say; all else that they say stays."""
    p = plan(tmp_path, BUDGETS, BASE + "policy: {name: worked, params: {rho: 0.3}, dwell_s: 2}\n")
    for run in range(p.runs):
        at = p.at(run)
        policy, rho = unpack(p.task(run))[0].policy, (0.1, 0.2)[at.cell % 2]
        assert p.varied(at.cell)["policy.params.rho"] == rho
        assert policy.name == ("worked", "deputies")[at.policy]
        assert policy.params == ({"rho": rho}, {"k": 1, "rho": rho})[at.policy]
        assert policy.dwell_s == 2
    assert p.key(0) != p.key(4)  # the next grid point, not the next replication


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("deputies(k=1)", "silence", "6: vary.policy.params.rho: policy 'silence' has no parameter 'rho', it has: none"),
        ("params.rho:", "params.roh:", "6: vary.policy.params.roh: policy 'worked' has no parameter 'roh', it has: rho"),
        (
            "deputies(k=1)", '"deputies(k=1, rho=0.5)"',
            "9: policies.1: deputies(k=1, rho=0.5) has its own policy.params.rho, which is varied; leave it out here",
        ),
        ("deputies(k=1)", "wurst-2", "9: policies.1: unknown policy 'wurst-2', did you mean worst-2? known: worked, "),
        ("deputies(k=1)", "deputies(q=1)", "9: policies.1: policy 'deputies' has no parameter 'q', it has: k, rho"),
        ("deputies(k=1)", "deputies(k)", "9: policies.1: policy 'deputies(k)': 'k' in the bracket, must be key=value"),
        ("policies: [worked, deputies(k=1)]", "set: {policy.name: wirkt}", "3: base: unknown policy 'wirkt', known: "),
    ],
)  # fmt: skip
def test_a_policy_that_cannot_fly_is_told_at_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in BUDGETS
    with pytest.raises(PolicyError) as error:
        plan(tmp_path, BUDGETS.replace(old, new))
    assert str(error.value).startswith(f"{tmp_path / 'small_ones.yaml'}:{message}")


def test_a_scenario_is_no_campaign_and_the_library_tells_them_apart() -> None:
    with pytest.raises(ScenarioError, match="is a scenario, a campaign begins with `campaign: its_name`"):
        load_campaign("track_target")
    assert load_campaign("link_battery").campaign.campaign == "link_battery"


def test_every_file_that_runs_read_is_in_the_key(tmp_path: Path) -> None:
    """Traces, weights, policies, and files that are varied, wherever they lie: beside the base, or the campaign."""
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.csv").write_text("t_s,drone,soc\n0,0,0.5\n")
    (tmp_path / "mine.py").write_text("def decide(view):\n    return []\n")
    base = BASE + "radio: {trace: c.csv}\n"
    (tmp_path / "c.csv").write_text("t_s,sender,receiver,loss\n0,0,1,0.5\n")
    vary = "fleet.trace: {kind: grid, values: [a.csv, b.csv]}"
    text = CAMPAIGN.replace("fleet.formation.spacing_m: {kind: grid, values: [20, 40]}", vary)
    text = text.replace("worked", "'mine.py:decide'")
    before = plan(tmp_path, text, base)
    assert set(before.spec["files"]) == {str(tmp_path / f) for f in ("a.csv", "b.csv", "c.csv", "mine.py")}
    sections = json.loads(before.task(0))["scenario"]
    assert sections["radio"]["trace"] == str(tmp_path / "c.csv")
    assert sections["fleet"]["trace"] == str(tmp_path / "a.csv")
    assert sections["policy"]["name"] == f"{tmp_path / 'mine.py'}:decide"
    for name in ("a.csv", "c.csv", "mine.py"):
        (tmp_path / name).write_text((tmp_path / name).read_text() + "\n")
        after = plan(tmp_path, text, base)
        assert after.key(0) != before.key(0), name
        before = after


def test_every_varied_model_is_in_the_key_wherever_it_is_named(tmp_path: Path) -> None:
    """Fields two levels deep, entries of lists, and lists given whole; a model's name alone is no file."""
    for name in ("loss", "watts", "rain", "hail", "snow", "mine"):
        (tmp_path / f"{name}.py").write_text("def model(*_):\n    pass\n")
    base = BASE + "events: [{kind: own, at_s: 0, model: 'rain.py:model'}]\nmetrics: {m: {model: 'mine.py:model'}}\n"
    vary = """radio.path_loss: {kind: grid, values: [two_ray, 'loss.py:model(db=3)']}
  fleet.airframe.power_model: {kind: grid, values: [level, 'watts.py:model']}
  events.0.model: {kind: choice, values: ['rain.py:model', 'hail.py:model']}
  metrics: {kind: grid, values: [{m: {model: 'snow.py:model'}}]}"""
    text = CAMPAIGN.replace("fleet.formation.spacing_m: {kind: grid, values: [20, 40]}", vary)
    before = plan(tmp_path, text, base)
    files = {str(tmp_path / f"{name}.py") for name in ("loss", "watts", "rain", "hail", "snow", "mine")}
    assert set(before.spec["files"]) == files
    flown = [json.loads(before.task(run))["scenario"] for run in range(before.runs)]
    assert {s["radio"]["path_loss"] for s in flown} == {"two_ray", f"{tmp_path / 'loss.py'}:model"}
    params = (s["radio"].get("path_loss_params") for s in flown if s["radio"]["path_loss"] != "two_ray")
    assert next(params) == {"db": 3}
    assert {s["fleet"]["airframe"]["power_model"] for s in flown} == {"level", f"{tmp_path / 'watts.py'}:model"}
    assert {s["events"][0]["model"] for s in flown} == {f"{tmp_path / f}.py:model" for f in ("rain", "hail")}
    assert {s["metrics"]["m"]["model"] for s in flown} == {f"{tmp_path / 'snow.py'}:model"}
    for file in sorted(files):
        Path(file).write_text(Path(file).read_text() + "\n")
        after = plan(tmp_path, text, base)
        assert after.key(0) != before.key(0), file
        before = after


def test_a_file_that_a_varied_parameter_names_is_in_the_key_and_found_beside_the_campaign(tmp_path: Path) -> None:
    """Also where the parameter's model is varied too, and where model and parameter stand in one text."""
    for name in "abcdef":
        (tmp_path / f"{name}.txt").write_text("1\n")
    (tmp_path / "mine.py").write_text(
        "def decide(view, *, table=''):\n    return []\n\ndef figure(record, *, table='', k=1):\n    return 1.0\n"
    )
    (tmp_path / "other.py").write_text((tmp_path / "mine.py").read_text())
    vary = """policy.params.table: {kind: grid, values: [a.txt, b.txt, plain]}
  metrics.m.model: {kind: choice, values: ['mine.py:figure', 'other.py:figure']}
  metrics.m.params.table: {kind: choice, values: [c.txt, d.txt]}
  perception.fusion: {kind: choice, values: ["mine.py:figure(table=e.txt, k=2)", "mine.py:figure(table='f.txt')"]}"""
    text = CAMPAIGN.replace("fleet.formation.spacing_m: {kind: grid, values: [20, 40]}", vary)
    text = text.replace('[worked, "best-2(received_budget=0.1)"]', "['mine.py:decide']")
    base = BASE + "metrics: {m: {model: 'mine.py:figure'}}\n"
    before = plan(tmp_path, text, base)
    assert set(before.spec["files"]) == {
        str(tmp_path / f) for f in ("mine.py", "other.py", *(f"{name}.txt" for name in "abcdef"))
    }
    flown = [json.loads(before.task(run))["scenario"] for run in range(before.runs)]
    tables = {s["policy"]["params"]["table"] for s in flown}
    assert tables == {str(tmp_path / "a.txt"), str(tmp_path / "b.txt"), "plain"}
    assert {s["metrics"]["m"]["params"]["table"] for s in flown} == {str(tmp_path / f"{name}.txt") for name in "cd"}
    assert {s["perception"]["fusion_params"]["table"] for s in flown} == {
        str(tmp_path / f"{name}.txt") for name in "ef"
    }
    (tmp_path / "b.txt").write_text("2\n")
    assert plan(tmp_path, text, base).key(0) != before.key(0)


@pytest.mark.parametrize("distinct", [2, 12])
def test_each_value_that_changes_a_model_is_worked_out_once_for_each_policy(
    distinct: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many rows have it, and however many other values the field has."""
    worked = list[object]()
    whole = planning._with
    monkeypatch.setattr(planning, "_with", lambda *given: worked.append(given) or whole(*given))
    (tmp_path / "mine.py").write_text("".join(f"def f{i}(*_):\n    pass\n" for i in range(distinct)))
    rows = [f"mine.py:f{i % distinct}" for i in range(24)]
    (tmp_path / "models.csv").write_text("\n".join(["fusion", *rows]) + "\n")
    text = CAMPAIGN.replace("fleet.formation.spacing_m: {kind: grid, values: [20, 40]}",
        "perception.fusion: {kind: column, file: models.csv, column: fusion}")  # fmt: skip
    made = plan(tmp_path, text)
    assert len(worked) == distinct * 2
    assert made.spec["columns"]["perception.fusion"] == [f"{tmp_path}/{row}" for row in rows]


def test_an_installed_model_s_package_is_in_the_key_and_a_worker_with_another_one_flies_nothing(tmp_path: Path) -> None:
    source = "def figure(record):\n    return 1.0\n"
    text = CAMPAIGN.replace("fleet.formation.spacing_m: {kind: grid, values: [20, 40]}",
        "metrics.m.model: {kind: choice, values: ['mine.py:figure', installed_figure]}")  # fmt: skip
    (tmp_path / "mine.py").write_text(source)
    with installed_package(tmp_path, "figures", source, {"metric": {"installed_figure": "figures:figure"}}):
        base = BASE + "metrics: {m: {model: 'mine.py:figure'}}\n"
        before = plan(tmp_path, text, base)
        assert list(before.spec["packages"]) == ["figures 1.2"]
        (tmp_path / "figures.py").write_text(source + "# otherwise\n")
        after = plan(tmp_path, text, base)
        assert (after.digest, after.key(0)) != (before.digest, before.key(0))
        assert fly_batch(after.code, [(0, after.task(0))])[0][0].status == "done"
        with pytest.raises(OtherCodeError, match=r"^figures 1\.2: this worker has other files of it than the campaign"):
            fly_batch(before.code, [(0, before.task(0))])
        newer = CampaignPlan({**after.spec, "packages": {"figures 1.3": ""}})
        with pytest.raises(OtherCodeError, match=r"^this worker has figures 1\.2, the campaign was begun with 1\.3$"):
            fly_batch(newer.code, [(0, newer.task(0))])


def test_the_version_of_a_package_that_a_policy_imports_is_in_the_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text(
        "import json\nfrom helper import x\n\ndef decide(view):\n    import numpy.random\n    return []\n"
    )
    (tmp_path / "helper.py").write_text("import yaml as x\nfrom sortie.policies.contract import Directive\n")
    text = CAMPAIGN.replace("worked", "'mine.py:decide'")
    before = plan(tmp_path, text)
    assert before.spec["packages"] == {f"{name} {version(name)}": "" for name in ("PyYAML", "numpy")}
    monkeypatch.setattr("sortie.sim.identity.installed", lambda name: "99")
    after = plan(tmp_path, text)
    assert after.key(0) != before.key(0)
    with pytest.raises(OtherCodeError, match=r"^this worker has PyYAML .*, the campaign was begun with 99$"):
        fly_batch(after.code, [(0, after.task(0))])


def test_another_policy_than_the_bases_own_flies_to_the_end(tmp_path: Path) -> None:
    """As in `sortie compare`: the base's changes and commands are its own policy's."""
    base = BASE + "policy: {name: worked, changes: [{at_s: 0.2, name: silence}]}\n"
    own, other = (json.loads(plan(tmp_path, base=base).task(run))["scenario"]["policy"] for run in (0, 1))
    assert (own["name"], [change["name"] for change in own["changes"]]) == ("worked", ["silence"])
    assert (other["name"], other["changes"]) == ("best-2", [])


@pytest.mark.parametrize("method", ["morris", "saltelli"])
def test_draws_that_share_values_stop_at_no_interval(method: str, tmp_path: Path) -> None:
    text = CAMPAIGN.replace("  fleet.formation.spacing_m: {kind: grid, values: [20, 40]}\n", "")
    text = text.replace("{count: 6}", f"{{count: 8, method: {method}}}")
    assert load_campaign(write(tmp_path, text)).campaign.sample.method == method
    path = write(tmp_path, text + "stop_when: {metric: bytes.data_sent, half_width: 1}\n")
    with pytest.raises(ScenarioError) as error:
        load_campaign(path)
    must = "must be left out, or another sample.method: its means have no intervals"
    assert str(error.value) == f"{path}:11: stop_when: {method}, {must}"


def test_a_shorter_campaign_leaves_out_what_its_base_does_later(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "base.yaml").write_text(
        "name: base\nduration_s: 9\nevents:\n  - {kind: drone_lost, at_s: 2, drone: 0}\n  - {kind: drone_lost, at_s: 8, drone: 1}\n"
    )
    file = tmp_path / "c.yaml"
    file.write_text("campaign: c\nbase: base.yaml\nset: {duration_s: 5}\npolicies: [worked]\nmetrics: [switches]\n")
    assert [event.at_s for event in load_campaign(file).base.events] == [2.0]
    assert "events: 1 of 2 begin at duration_s = 5 or later, and are left out" in caplog.text
    file.write_text(file.read_text().replace("duration_s: 5", "events.1.at_s: 9"))
    with pytest.raises(ScenarioError, match=r"events.1.at_s: 9, must be below duration_s = 9"):
        load_campaign(file)
