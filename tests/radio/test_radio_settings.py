"""The air's settings as plain values: they agree with the scenario's section, and `Air` runs on them alone."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from sortie.radio import AirSettings, BurstSettings
from sortie.scenarios.schema import Radio

ELSEWHERE = {"framing", "path_loss_params", "link_params"}
"""Fields of the section that callers of the air act on."""


def test_fields_and_defaults_are_those_of_a_scenarios_radio_section() -> None:
    settings = asdict(AirSettings())
    assert settings.pop("own_antennas") == {}, "makes have those"
    assert settings == Radio().model_dump(exclude=ELSEWHERE)
    assert list(settings) == [name for name in Radio.model_fields if name not in ELSEWHERE]


def test_a_section_becomes_settings() -> None:
    section = Radio.model_validate({"standard": "n", "bandwidth_mhz": 40, "bursts": {"good_to_bad": 0.1}})
    expected = AirSettings(standard="n", bandwidth_mhz=40, bursts=BurstSettings(good_to_bad=0.1))
    assert AirSettings.of(section.model_dump(exclude=ELSEWHERE)) == expected


def test_choices_of_the_schema_are_those_of_the_settings() -> None:
    for name in ("standard", "antenna", "path_loss", "rate_control"):
        field = Radio.model_json_schema()["properties"][name]
        for value in field.get("enum") or field["anyOf"][0]["enum"]:
            assert getattr(AirSettings(**{"bandwidth_mhz": 20, name: value}), name) == value


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"standard": "be"}, r"standard is 'be', must be one of \['n', 'ac', 'ax'\]"),
        ({"path_loss": "none"}, "path_loss is 'none', must be one of"),
        ({"standard": "n", "bandwidth_mhz": 80}, r"bandwidth_mhz is 80, must be one of \[20, 40\]"),
    ],
)
def test_an_unknown_choice_is_refused(values: dict[str, object], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        AirSettings.of(values)
