"""`sortie campaign worst`: the worst runs by a metric, and flying them again."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

import sortie
from sortie.sim.cli.app import app
from sortie.sim.experiment.worst import worst
from sortie.sim.folders import RunError

CAMPAIGN = """campaign: small
base: track_target
set: {duration_s: 2, perception.detector: none, fleet.drones: 2}
vary: {radio.tx_power_dbm: {kind: choice, values: [20, -15]}}
sample: {count: 4}
policies: [all-4, silence]
metrics: [bytes.data_delivered, deadline_miss_rate, frame_s]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    here = tmp_path_factory.mktemp("worst")
    (here / "small.yaml").write_text(CAMPAIGN)
    sortie.campaign(here / "small.yaml", out=here / "c", workers=1)
    return here / "c"


def test_they_are_the_worst_of_a_policy_or_of_all_and_in_order(folder: Path) -> None:
    rows = sortie.open_campaign(folder).rows.to_pylist()
    found = worst(folder, "bytes.data_delivered", 3)
    assert not found.more_is_worse
    assert [row["bytes.data_delivered"] for row in found.rows] == sorted(r["bytes.data_delivered"] for r in rows)[:3]
    assert found.varied == ["radio.tx_power_dbm"]
    most, least = (worst(folder, "bytes.data_delivered", 8, more_is_worse=more).rows for more in (True, None))
    assert [row["bytes.data_delivered"] for row in most] == [row["bytes.data_delivered"] for row in least][::-1]
    assert most[0]["bytes.data_delivered"] > 0
    assert {row["policy"] for row in worst(folder, "bytes.data_delivered", 8, "all-4").rows} == {"all-4"}
    assert {row["policy"] for row in worst(folder, "deadline_miss_rate", 8).rows} == {"all-4"}  # silence sends nothing


def test_what_cannot_be_asked_is_told(folder: Path) -> None:
    metrics = "bytes.data_delivered, deadline_miss_rate, frame_s"
    for arguments, message in (
        (("bytes.data_sent",), f"bytes.data_sent: no metric of .*c, must be {metrics}$"),
        (("frame_s",), "frame_s: whether more of it is worse is not known, say --most or --least$"),
        (("deadline_miss_rate", 3, "best-2"), "best-2: no policy of .*c, must be all-4, silence$"),
    ):
        with pytest.raises(RunError, match=message):
            worst(folder, *arguments)  # type: ignore[arg-type]


def test_the_command_shows_them_and_flies_the_first_again(folder: Path) -> None:
    command = ["campaign", "worst", str(folder), "deadline_miss_rate", "--count", "2", "--fly", "1"]
    said = CliRunner().invoke(app, command)
    assert said.exit_code == 0, said.output
    first = worst(folder, "deadline_miss_rate", 1).rows[0]
    assert re.search(rf"--from-campaign \S+ --run {first['run']} --view", said.output)
    again = sortie.open_run(folder / "worst" / f"run-{first['run']}").outcome
    assert again["fingerprint"].startswith(first["fingerprint"])
