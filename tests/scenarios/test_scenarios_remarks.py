"""What a scenario says without effect is told: it is no error, and it does not pass unnoticed."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from sortie.scenarios.reading.campaign import load_campaign
from sortie.scenarios.reading.load import ScenarioError, build, library, load
from sortie.scenarios.remarks import EDCA, UNREAD, remarks
from sortie.sim.check.named import not_there

# what is written, and the field that is told; each with what makes it count
WITHOUT_EFFECT = [
    ({"path_loss": "free_space", "path_loss_exponent": 3.0}, {"path_loss": "log_distance"}),
    ({"ground_roughness_m": 1.0}, {"path_loss": "two_ray"}),
    ({"shadowing_sigma_db": 0.0, "shadowing_time_s": 1.0}, {"shadowing_sigma_db": 2.0}),
    ({"bursts": {"bad_to_good": 0.5}}, {"bursts": {"bad_to_good": 0.5, "good_to_bad": 0.1}}),
    ({"edca": {"video": {"cw_min": 3}}}, {"payload_class": "video"}),
]


def test_a_field_that_the_chosen_model_ignores_is_told() -> None:
    for written, cure in WITHOUT_EFFECT:
        (line,) = remarks(build({"name": "a", "radio": written}))
        assert " is not read, as " in line, written
        assert remarks(build({"name": "a", "radio": written | cure})) == []


def test_what_begins_after_the_end_is_told() -> None:
    phases = [{"at_s": 0, "phase": "search"}, {"at_s": 5, "phase": "track"}]
    sections = {"name": "a", "duration_s": 5, "mission": {"phases": phases}}
    assert remarks(build(sections)) == [
        "mission.phases: 1 of 2 begin at duration_s = 5 or later, and never come",
    ]
    assert remarks(build(sections | {"duration_s": 5.1})) == []


def test_the_library_says_nothing_without_effect() -> None:
    assert {name: found for name in library() if (found := remarks(load(name)))} == {}


def test_the_rules_name_fields_of_the_schema() -> None:
    """A field that is renamed would else never be told again."""
    for field in [*EDCA, *(name for rule in UNREAD for name in (*rule.fields, rule.decider))]:
        *sections, name = field.split(".")
        at = build({"name": "a"})
        for section in sections:
            at = getattr(at, section)
        assert name in type(at).model_fields, field


def test_a_campaign_over_a_field_that_nothing_reads_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = """
campaign: flat
base: track_target
set: {radio.path_loss: MODEL}
policies: [worked]
vary: {radio.path_loss_exponent: {kind: grid, values: [2, 3]}}
metrics: [bytes.data_sent]
"""
    for model, told in (("free_space", 1), ("log_distance", 0)):
        caplog.clear()
        (tmp_path / "a.yaml").write_text(text.replace("MODEL", model))
        with caplog.at_level(logging.WARNING, logger="sortie"):
            load_campaign(tmp_path / "a.yaml")
        lines = [record.getMessage() for record in caplog.records if "vary." in record.getMessage()]
        assert len(lines) == told
        assert all(":6: vary.radio.path_loss_exponent: " in line for line in lines)


def test_an_expected_metric_that_no_outcome_has_is_told_before_a_flight() -> None:
    expected = {
        "ap50.misson": "ap50 has no 'misson', did you mean mission?",
        "ap50.mission": None,
        "drones.9.soc": "drones has no '9'",
        "policies.decisions.worked": None,
        "phases.0.data_rate_mbps": None,
    }
    for metric, words in expected.items():
        found = not_there(build({"name": "a", "expect": [{"metric": metric, "at_least": 0}]}))
        assert bool(found) == (words is not None), metric
        assert words is None or f"expect.0.metric: {metric}: {words}" in found[0]


def test_a_near_spelling_in_the_section_comes_before_the_same_word_elsewhere() -> None:
    """`drone` is a key of events, and most who write it under `fleet` mean `drones`."""
    with pytest.raises(ScenarioError, match=r"fleet\.drone: unknown key, did you mean drones\?"):
        build({"name": "a", "fleet": {"drone": 3}})
