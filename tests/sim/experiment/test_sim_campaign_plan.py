"""What a campaign flies: draws, grids, seeds, keys; and what is refused before anything flies."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path

import pytest
from campaign_examples import BASE, CAMPAIGN, Pretended, plan
from installed_package import installed_package

from sortie.sim.experiment.drive import run_campaign
from sortie.sim.experiment.flight import OtherCodeError, fly_in_worker
from sortie.sim.experiment.plan import CampaignPlan

SPACING = "fleet.formation.spacing_m: {kind: grid, values: [20, 40]}"
"""The line of the campaign in whose place tests vary another field."""


def test_every_combination_is_flown_once_and_policies_of_a_scene_share_their_seed(tmp_path: Path) -> None:
    p = plan(tmp_path)
    assert (p.runs, p.cells, p.units, p.shard) == (48, 12, 6, 30)
    at = [p.at(run) for run in range(p.runs)]
    assert len({(a.cell, a.replication, a.policy) for a in at}) == p.runs
    for first, second in zip(at[::2], at[1::2], strict=True):
        assert (first.cell, first.replication) == (second.cell, second.replication)
        a, b = (json.loads(p.task(x.run).scenario) for x in (first, second))
        assert (a.pop("policy")["name"], b.pop("policy")["name"]) == ("worked", "best-2")
        assert p.task(first.run).seed == p.task(second.run).seed == p.seed(first.cell)
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


def test_the_grid_is_of_files_columns_and_steps(tmp_path: Path) -> None:
    """Columns of one file go together and cross with the rest; a linspace over whole numbers gives whole numbers."""
    (tmp_path / "links.csv").write_text("power,sigma\n10,2\n12.5,3\n")
    columns = "  radio.tx_power_dbm: {kind: column, file: links.csv, column: power}\n"
    columns += "  radio.shadowing_sigma_db: {kind: column, file: links.csv, column: sigma}\n"
    grid = plan(tmp_path, CAMPAIGN.replace("sample:", columns + "sample:")).grid
    names = ("fleet.formation.spacing_m", "radio.tx_power_dbm", "radio.shadowing_sigma_db")
    assert [tuple(g[n] for n in names) for g in grid] == [(20, 10, 2), (20, 12.5, 3), (40, 10, 2), (40, 12.5, 3)]
    text = CAMPAIGN.replace(SPACING, "fleet.drones: {kind: linspace, low: 2, high: 4, count: 3}")
    assert [g["fleet.drones"] for g in plan(tmp_path, text).grid] == [2, 3, 4]


def test_whatever_decides_what_is_flown_changes_the_key(tmp_path: Path) -> None:
    before = plan(tmp_path)
    for old, new, changed in (
        ("seed: 5", "seed: 6", [True, True]),
        ("low: 0.2", "low: 0.21", [True, True]),
        ("energy_j.total", "energy_j.rotor", [False, False]),  # another figure of the same flight
        ("received_budget=0.1", "received_budget=0.11", [False, True]),  # the other policy's runs are what they were
    ):
        after = plan(tmp_path, CAMPAIGN.replace(old, new))
        assert [before.task(run).key != after.task(run).key for run in range(before.runs)] == changed * 24, old
    assert plan(tmp_path, base=BASE.replace("0.5", "0.6")).task(0).key != before.task(0).key
    assert CampaignPlan({**before.spec, "code": "other"}).task(0).key != before.task(0).key


def test_a_module_that_a_policy_imports_is_part_of_what_is_flown(tmp_path: Path) -> None:
    """An edit of it between two halves of a campaign must not put rows of two codes into one table."""
    (tmp_path / "mine.py").write_text("def decide(view):\n    from deep import answer\n    return answer(view)\n")
    (tmp_path / "deep.py").write_text("from deeper import nothing\n\n\ndef answer(view):\n    return nothing()\n")
    (tmp_path / "deeper.py").write_text("def nothing():\n    return []\n")
    text = CAMPAIGN.replace("worked", "'mine.py:decide'")
    before = plan(tmp_path, text)
    assert set(before.spec["files"]) == {str(tmp_path / f"{name}.py") for name in ("mine", "deep", "deeper")}
    run_campaign(before, tmp_path / "out", Pretended())
    (tmp_path / "deeper.py").write_text("def nothing():\n    return [] # otherwise\n")
    rest, said = Pretended(), list[str]()
    run_campaign(plan(tmp_path, text), tmp_path / "out", rest, notice=said.append)
    assert len(rest.flown) == before.runs
    deeper = tmp_path / "deeper.py"
    assert said == [f"{tmp_path / 'out'}: {deeper} has changed since; {before.runs} flights with it are flown again"]


def test_every_file_that_runs_read_is_known_wherever_it_is_named(tmp_path: Path) -> None:
    """Traces, a policy, fields two levels deep, entries of lists, and lists given whole; a model's name is no file."""
    models = [tmp_path / f"{name}.py" for name in ("loss", "watts", "rain", "hail", "snow", "own", "mine")]
    traces = [tmp_path / f"{name}.csv" for name in ("a", "b", "c")]
    for file in models:
        file.write_text("def model(*_):\n    pass\n")
    for file in traces:
        file.write_text("t_s,drone,soc\n0,0,0.5\n")
    (tmp_path / "c.csv").write_text("t_s,sender,receiver,loss\n0,0,1,0.5\n")
    base = BASE + "events: [{kind: own, at_s: 0, model: 'rain.py:model'}]\nmetrics: {m: {model: 'own.py:model'}}\n"
    vary = """radio.path_loss: {kind: grid, values: [two_ray, 'loss.py:model(db=3)']}
  fleet.airframe.power_model: {kind: grid, values: [level, 'watts.py:model']}
  events.0.model: {kind: choice, values: ['rain.py:model', 'hail.py:model']}
  metrics: {kind: grid, values: [{m: {model: 'snow.py:model'}}]}
  fleet.trace: {kind: grid, values: [a.csv, b.csv]}"""
    text = CAMPAIGN.replace(SPACING, vary).replace("worked", "'mine.py:model'").replace("{count: 6}", "{count: 2}")
    text = text.replace("replications: 2", "replications: 1")
    base += "radio: {trace: c.csv}\n"
    before = plan(tmp_path, text, base)
    assert set(before.spec["files"]) == set(map(str, models + traces))
    flown = [json.loads(before.task(run).scenario) for run in range(before.runs)]
    assert {s["radio"]["path_loss"] for s in flown} == {"two_ray", f"{tmp_path}/loss.py:model"}
    params = (s["radio"].get("path_loss_params") for s in flown if s["radio"]["path_loss"] != "two_ray")
    assert next(params) == {"db": 3}
    assert {s["radio"]["trace"] for s in flown} == {f"{tmp_path}/c.csv"}
    assert {s["fleet"]["trace"] for s in flown} == {f"{tmp_path}/a.csv", f"{tmp_path}/b.csv"}
    assert {s["fleet"]["airframe"]["power_model"] for s in flown} == {"level", f"{tmp_path}/watts.py:model"}
    assert {s["events"][0]["model"] for s in flown} == {f"{tmp_path}/{f}.py:model" for f in ("rain", "hail")}
    assert {s["metrics"]["m"]["model"] for s in flown} == {f"{tmp_path}/snow.py:model"}
    assert flown[0]["policy"]["name"] == f"{tmp_path}/mine.py:model"
    for file in models + traces:
        file.write_text(file.read_text() + "\n")
        after = plan(tmp_path, text, base)
        assert after.task(0).files != before.task(0).files, file
        before = after


def test_a_file_that_a_varied_parameter_names_is_known_and_found_beside_the_campaign(tmp_path: Path) -> None:
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
    text = CAMPAIGN.replace(SPACING, vary)
    text = text.replace('[worked, "best-2(received_budget=0.1)"]', "['mine.py:decide']")
    base = BASE + "metrics: {m: {model: 'mine.py:figure'}}\n"
    before = plan(tmp_path, text, base)
    assert set(before.spec["files"]) == {
        str(tmp_path / f) for f in ("mine.py", "other.py", *(f"{name}.txt" for name in "abcdef"))
    }
    flown = [json.loads(before.task(run).scenario) for run in range(before.runs)]
    tables = {s["policy"]["params"]["table"] for s in flown}
    assert tables == {str(tmp_path / "a.txt"), str(tmp_path / "b.txt"), "plain"}
    assert {s["metrics"]["m"]["params"]["table"] for s in flown} == {str(tmp_path / f"{name}.txt") for name in "cd"}
    assert {s["perception"]["fusion_params"]["table"] for s in flown} == {
        str(tmp_path / f"{name}.txt") for name in "ef"
    }
    (tmp_path / "b.txt").write_text("2\n")
    assert plan(tmp_path, text, base).task(0).files != before.task(0).files


def test_an_installed_model_s_package_is_in_the_key_and_a_worker_with_another_one_flies_nothing(tmp_path: Path) -> None:
    source = "def figure(record):\n    return 1.0\n"
    text = CAMPAIGN.replace(SPACING, "metrics.m.model: {kind: choice, values: ['mine.py:figure', installed_figure]}")
    (tmp_path / "mine.py").write_text(source)
    with installed_package(tmp_path, "figures", source, {"metric": {"installed_figure": "figures:figure"}}):
        base = BASE + "metrics: {m: {model: 'mine.py:figure'}}\n"
        before = plan(tmp_path, text, base)
        assert list(before.spec["packages"]) == ["figures 1.2"]
        (tmp_path / "figures.py").write_text(source + "# otherwise\n")
        after = plan(tmp_path, text, base)
        assert after.task(0).key != before.task(0).key
        assert fly_in_worker(after.task(0)).error == ""
        with pytest.raises(
            OtherCodeError, match=r"^figures 1\.2: this worker has other files of it than the experiment"
        ):
            fly_in_worker(before.task(0))
        newer = CampaignPlan({**after.spec, "packages": {"figures 1.3": ""}})
        with pytest.raises(OtherCodeError, match=r"^this worker has figures 1\.2, the experiment was begun with 1\.3$"):
            fly_in_worker(newer.task(0))


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
    assert after.task(0).key != before.task(0).key
    with pytest.raises(OtherCodeError, match=r"^this worker has PyYAML .*, the experiment was begun with 99$"):
        fly_in_worker(after.task(0))


def test_another_policy_than_the_bases_own_flies_to_the_end(tmp_path: Path) -> None:
    """As in `sortie compare`: the base's changes and commands are its own policy's."""
    base = BASE + "policy: {name: worked, changes: [{at_s: 0.2, name: silence}]}\n"
    own, other = (json.loads(plan(tmp_path, base=base).task(run).scenario)["policy"] for run in (0, 1))
    assert (own["name"], [change["name"] for change in own["changes"]]) == ("worked", ["silence"])
    assert (other["name"], other["changes"]) == ("best-2", [])
