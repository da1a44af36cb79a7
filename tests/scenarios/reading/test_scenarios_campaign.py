"""Campaigns: what their sections ask of each other, their base and columns, and the ends of what is varied."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sortie.scenarios.reading.campaign import Study, extremes, load_campaign
from sortie.scenarios.reading.load import ScenarioError
from sortie.scenarios.schema.campaign import Campaign, Integers, Linspace, Normal, Uniform

GRID: dict[str, Any] = {"kind": "grid", "values": [1, 2]}
DRAWN: dict[str, Any] = {"kind": "uniform", "low": 0.5, "high": 1.0}
STOP: dict[str, Any] = {"metric": "wall_s", "half_width": 1.0, "difference": True}


def varied(**spread: Any) -> dict[str, Any]:
    return {"vary": {"a.b": spread}}


def sampled(method: str, count: int, **more: Any) -> dict[str, Any]:
    return {"vary": {"a.b": DRAWN, **more}, "sample": {"method": method, "count": count}}


def chosen(*weights: float) -> dict[str, Any]:
    return varied(kind="choice", values=[1, 2], weights=list(weights))


BOUNDS: list[tuple[dict[str, Any], str, dict[str, Any] | None]] = [
    (sampled("sobol", 6), "a power of two", sampled("sobol", 8)),
    (sampled("saltelli", 6), "a power of two", sampled("saltelli", 8)),
    (sampled("morris", 4, **{"a.c": GRID}), "every field of vary drawn", sampled("morris", 6)),
    ({"stop_when": STOP}, "false where there is one policy", {"stop_when": STOP, "policies": ["worked", "silence"]}),
    (chosen(0.0, 0.0), "at least 0, and one above it", chosen(0.0, 1.0)),
    (chosen(2.0, -1.0), "at least 0, and one above it", sampled("random", 6)),
    (varied(kind="normal", mean=0.0, sd=1.0, low=-1.0, high=-2.0), "below high", None),
    *(
        ({"vary": {name: GRID}}, name, {"vary": {other: GRID}})  # what the plan writes itself is not varied
        for name, other in (
            ("seed", "seeds"),
            ("policy.name", "policy.names"),
            ("policy", "policy.params.rho"),
            ("policy.changes.0.at_s", "a"),
            ("policy.commands", "b"),
            ("policy.params", "c"),
        )
    ),
]
"""What is refused, in which words, and its neighbour that is accepted."""


def refusal(changes: dict[str, Any]) -> str:
    try:
        Campaign.model_validate({"campaign": "c", "base": "b", "metrics": ["wall_s"], **changes})
    except ValueError as error:
        return str(error)
    return ""


def test_what_is_refused_is_named_and_its_neighbour_is_accepted() -> None:
    said = [(refusal(wrong), words, right is None or refusal(right)) for wrong, words, right in BOUNDS]
    assert [(found, words) for found, words, _ in said if words not in found] == []
    assert [accepted for _, _, accepted in said if accepted not in (True, "")] == []


def study(folder: Path, base: dict[str, Any] | None = None, **changes: Any) -> Study:
    (folder / "base.yaml").write_text(json.dumps({"name": "base", "duration_s": 9.0, **(base or {})}))
    sections = {"campaign": "c", "base": "base.yaml", "metrics": ["wall_s"], **changes}
    (folder / "c.yaml").write_text(json.dumps(sections))
    return load_campaign(folder / "c.yaml")


ENDS: list[tuple[Any, list[float]]] = [
    (Linspace(kind="linspace", low=2, high=6, count=3), [2, 6]),
    (Linspace(kind="linspace", low=0.5, high=6, count=3), [0.5, 6]),
    (Linspace(kind="linspace", low=1.0, high=2.5, count=4), [1, 2.5]),
    (Integers(kind="integers", low=2, high=6), [2, 6]),
    (Uniform(kind="uniform", low=0.5, high=1.5), [0.5, 1.5]),
    (Normal(kind="normal", mean=3, sd=1), [3]),
    (Normal(kind="normal", mean=3, sd=1, high=5), [5]),
]


def test_a_field_is_held_against_the_ends_of_its_spread_as_they_are_flown(tmp_path: Path) -> None:
    """Whole numbers as whole numbers, since some fields take no others."""
    for spread, ends in ENDS:
        found = list(extremes(spread, ()))
        assert found == ends
        whole = isinstance(spread, Linspace | Integers)
        assert [isinstance(v, int) for v in found] == [whole and v == int(v) for v in ends]
    assert study(tmp_path, vary={"fleet.drones": {"kind": "linspace", "low": 2, "high": 6, "count": 3}}).drones == 6
    for low, high, wrong in ((0.5, 1.0, ""), (0.0, 1.0, "0, must be"), (0.5, 1.1, "1.1, must be")):
        kinds: list[dict[str, Any]] = [{"kind": "uniform"}, {"kind": "normal", "mean": 0.7, "sd": 0.1}]
        for kind in (*kinds, {"kind": "linspace", "count": 3}, {"kind": "triangular", "mode": 0.7}):
            vary = {"fleet.battery.initial_soc": {**kind, "low": low, "high": high}}
            if not wrong:
                assert study(tmp_path, vary=vary).drones == 5
                continue
            with pytest.raises(ScenarioError, match=wrong):
                study(tmp_path, vary=vary)


@pytest.mark.parametrize("counts", [[2, 7, 3], [7, 2, 3], [3, 2, 7]])
def test_a_campaign_has_room_for_its_largest_fleet_and_longest_mission_wherever_they_stand(
    counts: list[int], tmp_path: Path
) -> None:
    """In a list, in a file's column, and at either end of a range."""
    base = {"fleet": {"drones": 4}, "mission": {"phases": [{"at_s": 0, "phase": "search"}]}}
    (tmp_path / "column.csv").write_text("\n".join(["n", *map(str, counts)]) + "\n")
    phases = [[{"at_s": k, "phase": "search"} for k in range(n)] for n in counts]
    spreads: list[dict[str, Any]] = [{"kind": "grid", "values": counts}, {"kind": "choice", "values": counts}]
    spreads += [{"kind": "column", "file": "column.csv", "column": "n"}, {"kind": "integers", "low": 2, "high": 7}]
    for spread in spreads:
        vary = {"fleet.drones": spread, "mission.phases": {"kind": "grid", "values": phases}}
        found = study(tmp_path, base, vary=vary, policies=["worked"])
        assert (found.drones, found.phases) == (7, 7)


def test_a_campaign_leaves_out_what_its_base_expects(tmp_path: Path) -> None:
    """Of figures and of decisions alike: with fewer drones or a shorter flight it need not hold, nor make sense."""
    decisions = [{"drone": 3, "from_s": 6.0, "until_s": 8.0}]
    expect = [{"metric": "ap50.full_scene", "at_least": 0.1}]
    base = {"fleet": {"drones": 4}, "expect": expect, "expect_decisions": decisions}
    for changes in ({"vary": {"fleet.drones": {"kind": "grid", "values": [2, 3]}}}, {"set": {"duration_s": 5.0}}):
        found = study(tmp_path, base, **changes)
        assert (found.base.expect, found.base.expect_decisions) == ((), ())


def test_columns_of_one_file_stay_side_by_side_and_may_hold_words(tmp_path: Path) -> None:
    """An empty cell is one too; true is a word there. A value that the scenario refuses is named with its row."""
    (tmp_path / "v.csv").write_bytes(b"\xef\xbb\xbfa,Power ,b\r\nworked,10,1.5\r\n\r\n,12.5,2\r\ntrue,3,-3\r\n")
    fields = {"description": "a", "policy.params.x": "b", "radio.tx_power_dbm": "power"}
    vary = {field: {"kind": "column", "file": "v.csv", "column": column} for field, column in fields.items()}
    found = study(tmp_path, vary=vary).columns
    power = {"radio.tx_power_dbm": (10, 12.5, 3)}
    assert found == {"description": ("worked", "", "true"), "policy.params.x": (1.5, 2, -3), **power}
    assert [type(v) for v in found["policy.params.x"]] == [float, int, int]
    (tmp_path / "v.csv").write_text("a,power,b\nx,10,1\ny,much,2\n")
    with pytest.raises(ScenarioError, match=r"radio.tx_power_dbm: much, must be a number \(v.csv: power in row 2\)$"):
        study(tmp_path, vary=vary)


def test_files_that_a_base_names_lie_beside_the_base_or_beside_the_campaign(tmp_path: Path) -> None:
    """Those of `set` beside the campaign, and those of a base in another folder beside that."""
    (tmp_path / "own").mkdir()
    for name in ("own/a.csv", "b.csv"):
        (tmp_path / name).write_text("t_s,sender,receiver,snr_db\n0,0,1,20\n")
    (tmp_path / "own" / "base.yaml").write_text(json.dumps({"name": "base", "radio": {"trace": "a.csv"}}))
    for changes, file in (({}, "own/a.csv"), ({"set": {"radio.trace": "b.csv"}}, "b.csv")):
        sections = {"campaign": "c", "base": "own/base.yaml", "metrics": ["wall_s"], **changes}
        (tmp_path / "c.yaml").write_text(json.dumps(sections))
        assert load_campaign(tmp_path / "c.yaml").base.radio.trace == str(tmp_path / file)


def test_a_field_named_thousands_deep_is_one_line(tmp_path: Path) -> None:
    """It ended in RecursionError."""
    fields = f"set:\n  {'.'.join('a' * 500)}: 1\n"
    (tmp_path / "a.yaml").write_text(f"campaign: a\nbase: track_target\nmetrics: [ap50]\n{fields}")
    with pytest.raises(ScenarioError, match=r"a\.yaml:\d+: .*levels deep, must be at most 20$"):
        load_campaign(tmp_path / "a.yaml")
