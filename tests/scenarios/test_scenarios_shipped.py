"""What belongs to a network: its calibration, its codebook and its box errors lie beside its weights."""

from __future__ import annotations

from pathlib import Path

import pytest

from sortie.scenarios.reading.files import named_files
from sortie.scenarios.shipped import CALIBRATION, CODEBOOK, ERRORS, NETWORKS, beside, calibration_of, companions

WHOLE = {CALIBRATION, CODEBOOK, ERRORS, beside(Path(CALIBRATION), ERRORS).name}


def test_a_calibration_beside_a_network_is_meant_by_its_weights(tmp_path: Path) -> None:
    weights, fitted = tmp_path / "mine.safetensors", tmp_path / "mine.surrogate.safetensors"
    weights.touch()
    assert calibration_of(weights) == weights, "it may be a calibration itself"
    fitted.touch()
    assert calibration_of(weights) == calibration_of(fitted) == fitted


def test_of_a_shipped_network_all_files_are_named_without_their_folder() -> None:
    found = companions(Path("disconet.safetensors"))
    assert {path.name.removeprefix("disconet") for path in found} == WHOLE
    assert all(path.parent == Path() and (NETWORKS / path).is_file() for path in found)


@pytest.mark.parametrize("suffix", sorted(WHOLE))
def test_a_scenario_names_what_belongs_to_its_weights(tmp_path: Path, suffix: str) -> None:
    weights = tmp_path / "mine.safetensors"
    sections = {"perception": {"weights": str(weights)}, "fleet": {"makes": [{"weights": str(weights)}]}}
    assert set(named_files(sections)) == {str(weights)}
    own = beside(weights, suffix)
    own.touch()
    assert set(named_files(sections)) == {str(weights), str(own)}
