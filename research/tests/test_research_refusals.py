"""Options of the laboratory's commands: honoured or refused, and refused before anything is computed."""

from __future__ import annotations

from pathlib import Path

import pytest
from laboratory import command, refusal
from sim_examples import BASE


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("learn", "--out", "."), ".: is a folder, must be a file"),
        (("learn", "--set", "perception.jion=nms"), "perception.jion: unknown key, did you mean join?"),
        (("fit", "errors", "--weights", "w.safetensors", "--out", "."), ".: is a folder, must be a file"),
        (("train", "--fusion", "mean"), "unknown fusion 'mean', known: none, late,"),
        (("train", "--peak-lr", "nan"), "peak_lr is nan, must be above 0 and at most 1"),
        (("train", "--device", "tpu"), "device is 'tpu', must be one of auto, cpu"),
        (("train", "--device", "cuda:99"), "device is 'cuda:99', must be one of auto, cpu"),
        (("calibrate", "--out", "."), ".: is a folder, must be a file"),
        (("train", "--warm-start", "w.safetensors"), "w.safetensors: no such weights"),
        (("train", "--out", "."), ".: is a folder, must be a file"),
        (
            ("paper", "--frame", "0", "--readme", "example.yaml"),
            "--readme goes with the whole report, not with --frame",
        ),
        (("paper", "--frame", "0", "--against", "."), "--against goes with the whole report, not with --frame"),
        (("paper", "--ego", "1"), "--ego goes with --frame"),
        (("paper", "--view"), "--view goes with --frame"),
        (("calibrate", "--policies", "boxes"), "--policies goes with --fly"),
        (("calibrate", "--rate-hz", "1"), "--rate-hz goes with --fly"),
        (("calibrate", "--towns", "1"), "--towns goes with --fly"),
        (("calibrate", "--made", "m"), "--made goes with --fly"),
        (("fit", "errors", "--towns", "5"), "--towns goes with python -m research fit errors surrogate"),
        (
            ("fit", "errors", "surrogate", "--bench-seed", "0"),
            "--bench-seed goes with python -m research fit errors torch",
        ),
        (("fit", "errors", "surrogate", "--bench", "b"), "--bench goes with python -m research fit errors torch"),
        (("paper", "--readme", "example.yaml"), "must hold <!-- paper"),
        (("study", "report", "--readme", "example.yaml"), "must hold <!-- study"),
    ],
)
def test_what_cannot_be_honoured_is_refused_before_anything_is_computed(
    tmp_path: Path, arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "example.yaml").write_text(BASE)
    assert message in refusal(tmp_path, arguments, capsys)


def test_a_study_replaces_no_file_that_it_did_not_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "study"
    out.mkdir()
    for name in ("study.parquet", "README.md", "contrasts.png", "notes.txt"):
        (out / name).write_text(name)
    assert command("study", "report", out / "study.parquet", "--out", out) == 2
    said = capsys.readouterr().err
    assert said == f"error: {out}: holds notes.txt, which no report wrote; choose another folder or move it\n"
    assert (out / "notes.txt").read_text() == "notes.txt"


def test_the_overhead_of_a_policy_with_parameters(capsys: pytest.CaptureFixture[str]) -> None:
    """It was split at the comma within the brackets, and parameters were no part of a policy."""
    assert (
        command("overhead", "--policies", "best-2(received_budget=0.1, k=1),silence", "--drones", "2", "--seconds", "1")
        == 0
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert "best-2" in printed
    assert "silence" in printed


@pytest.mark.parametrize("seconds", ["inf", "7201"])
def test_overhead_flies_at_most_as_long_as_a_scenario(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("overhead", "--seconds", seconds) == 2
    assert "7200" in capsys.readouterr().err
