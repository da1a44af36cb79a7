"""An outcome is a dictionary that computes what is read of it, once, and no more."""

from __future__ import annotations

import copy
import json
import pickle
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pprint import pformat
from typing import Any

import pytest
import record_by_hand as by_hand
from recorded import recorded
from sim_examples import example

from sortie.sim.experiment.flight import OUTCOME, fly, task_of
from sortie.sim.results import accuracy, traffic
from sortie.sim.results.outcome import OutcomeDict, outcome
from sortie.sim.results.outcome_fields import FIGURES, Outcome


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each field is computed, and each part that several fields need."""
    counts: Counter[str] = Counter()
    recorded("surrogate")  # where nobody has flown it yet, its run is saved, with the whole outcome

    def counted(name: str, compute: Callable[..., Any]) -> Callable[..., Any]:
        def counting(*args: Any, **options: Any) -> Any:
            counts[name] += 1
            return compute(*args, **options)

        return counting

    for name, compute in FIGURES.items():
        monkeypatch.setitem(FIGURES, name, counted(name, compute))
    for module, name in ((accuracy, "score"), (traffic, "traffic")):
        monkeypatch.setattr(module, name, counted(f"{name}()", getattr(module, name)))
    return counts


def test_what_is_read_is_computed_once_and_with_it_what_it_needs(computed: Counter[str]) -> None:
    result = outcome(recorded("surrogate"))
    assert len(result) == len(Outcome.model_fields)
    assert "people" in result
    assert not computed
    assert result["ap50"]["mission"] == result.get("ap50.mission") == result.number("ap50.mission") is not None
    assert computed == {"ap50": 1, "score()": 1}
    assert result.get("bytes.data_sent") > 0
    assert result["ap50"] is result["ap50"]
    assert computed == {"ap50": 1, "score()": 1, "bytes": 1, "traffic()": 1}
    for _ in range(2):
        result.flat()
        assert dict.fromkeys(FIGURES, 1) | {"score()": 1, "traffic()": 1} == computed


def test_a_flight_of_an_experiment_computes_what_its_figures_name(computed: Counter[str]) -> None:
    """Flights of its own: what a task asks for decides what is computed after it."""
    scenario = example("duration_s=1", "perception.detector=surrogate")
    for figures, fields in (
        (["ap50.full_scene", "ap50.mission"], {"ap50", "score()"}),
        (
            ["payload_fates.lost/no_link", "seed"],
            {"payload_fates", "traffic()", "battery", "seed"},
        ),  # battery: how many drones
        ([OUTCOME], {*FIGURES, "score()", "traffic()"}),
    ):
        computed.clear()
        row = fly(task_of(scenario, figures))
        assert (row.error, row.values.keys(), computed.keys()) == ("", set(figures), fields)


def test_a_figure_that_cannot_be_computed_is_no_matter_where_nobody_reads_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(flown: object) -> None:
        raise ZeroDivisionError

    for name in FIGURES.keys() - {"ap50"}:
        monkeypatch.setitem(FIGURES, name, fail)
    task = task_of(example("duration_s=1", "perception.detector=surrogate"), ["ap50.full_scene"])
    assert fly(task).values["ap50.full_scene"] > 0
    with pytest.raises(ZeroDivisionError):
        fly(replace(task, figures=["tracking.hota"]))


def test_it_is_used_as_any_dictionary() -> None:
    """Each use begins with an outcome of which nothing has been computed."""
    plain = json.loads(json.dumps(outcome(by_hand.record())))
    uses: dict[str, Callable[[dict[str, Any]], Any]] = {
        "json": json.dumps,
        "json with indent": lambda o: json.dumps(o, indent=2),
        "json, sorted": lambda o: json.dumps({"inner": [o]}, sort_keys=True),
        "dict": dict,
        "copy": copy.copy,
        "deepcopy": copy.deepcopy,
        ".copy": lambda o: o.copy(),
        "pickle": lambda o: pickle.loads(pickle.dumps(o)),  # noqa: S301
        "**": lambda o: {**o},
        "keywords": lambda o: (lambda **keywords: keywords)(**o),
        "|": lambda o: o | {"more": 1},
        "reversed |": lambda o: {"more": 1} | o,
        "keys": lambda o: [*o, *o.keys(), *reversed(o)],
        "items": lambda o: list(o.items()),
        "values": lambda o: list(o.values()),
        "pop": lambda o: (o.pop("tracking"), o.pop("nothing", 3), len(o)),
        "popitem": lambda o: o.popitem(),
        "setdefault": lambda o: (o.setdefault("bytes", 1), o.setdefault("more", 1)),
        "get": lambda o: (o.get("bytes"), o.get("more"), o.get("more", 5)),
        "repr": repr,
        "pprint": pformat,
        "format": lambda o: f"{o}",
        "!=": lambda o: (o != plain, plain != outcome(by_hand.record())),
        "==": lambda o: (o == plain, plain == o, o == {}, o == outcome(by_hand.record())),
    }
    assert [name for name, use in uses.items() if use(outcome(by_hand.record())) != use(copy.deepcopy(plain))] == []
    with pytest.raises(KeyError):
        outcome(by_hand.record())["nothing"]


def test_a_notebook_shows_it_as_any_dictionary() -> None:
    pretty = pytest.importorskip("IPython.lib.pretty").pretty
    assert pretty(outcome(by_hand.record())) == pretty(dict(outcome(by_hand.record())))


def test_names_with_dots_find_figures_and_flat_gives_all_numbers() -> None:
    result = outcome(by_hand.record())
    wanted = {
        **{"bytes.data_sent": result["bytes"]["data_sent"], "phases.1.begin_s": 2.0, "drones.1.airborne": False},
        **{"payload_fates.lost/no_link": 0, "distrusted_by.7": None, "scenario": "by_hand", "ap50": result["ap50"]},
        **{"phases.2.begin_s": None, "bytes.none": None, "seed.more": None},
    }
    assert {name: result.get(name) for name in wanted} == wanted
    with pytest.raises(KeyError, match=r"bytes.none: bytes has no 'none', it has context_sent, context_descriptors"):
        result.at("bytes.none")
    with pytest.raises(KeyError, match=r"phases.2.begin_s: phases has no '2', it has 0 … 1"):
        result.at("phases.2.begin_s")
    flat = result.flat()
    assert all(type(value) in (int, float) and result.at(name) == value for name, value in flat.items())
    assert {"seed", "phases.1.begin_s", "bytes.data_sent", "events.0.t_s"} - flat.keys() == {"events.0.t_s"}  # no event
    assert "drones.1.airborne" not in flat
    assert "people.ap_2m" not in flat


def test_one_that_was_read_from_its_file_is_the_same() -> None:
    result = outcome(recorded("members"))
    read = OutcomeDict(json.loads(json.dumps(result)))
    assert type(read) is type(result)
    assert (read, read.flat(), read.model()) == (result, result.flat(), result.model())
    assert read.model().transitions[0].from_ == result["transitions"][0]["from"]
