"""Policies of a user's own in a campaign: whatever one does is one failed run, and nothing else."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from campaign_examples import BASE, CAMPAIGN, write

import sortie

pytestmark = pytest.mark.slow

POLICY = """
import hashlib, os, sys, time
from sortie.policies.contract import Directive

def silent(view):
    return [Directive(view.ego, p, reason="silent") for p in view.peers]

def decide(view):
    if view.me.battery_soc < 0.5:
        {what}
    return silent(view)
"""
LATE = "LimitError: no answer within 2 s (limits.decision_s) (mine.py, line 10)"


@pytest.mark.parametrize(
    ("what", "error"),
    [
        ("sys.exit(0)", "raises ProgramExitError: exit code 0, must return (mine.py, line 10)"),
        ("while True: pass", LATE),
        ("hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)", LATE),
        ("os.kill(os.getpid(), 9)", "WorkerDied: on every attempt"),
    ],
)
def test_what_a_policy_does_is_one_failed_run(
    what: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The driver flies nothing itself: its process has another number than those that load the policy."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(POLICY.format(what=what))
    text = CAMPAIGN.replace('[worked, "best-2(received_budget=0.1)"]', "['mine.py:decide']").replace(
        "replications: 2", "replications: 1"
    )
    text = text.replace("{count: 6}", "{count: 3}").replace("values: [20, 40]", "values: [20]")
    campaign = write(tmp_path, text, BASE + "limits: {decision_s: 2}\n")
    done = sortie.campaign(campaign, out=tmp_path / "a", workers=0)
    rows = pq.read_table(tmp_path / "a" / "runs").to_pylist()
    failed = [row for row in rows if row["fleet.battery.initial_soc"] < 0.5]
    assert (done.finished, done.failed) == (3, len(failed))
    assert 0 < len(failed) < 3
    assert [row["status"] == "failed" for row in rows] == [row in failed for row in rows]
    for row in failed:
        assert error in row["error"]
        assert row["seed"] is not None
    assert sortie.campaign(campaign, out=tmp_path / "a", workers=0).flown == 0, "a resume does not stop there again"


def test_the_driver_runs_no_decision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DRIVER", str(os.getpid()))
    (tmp_path / "mine.py").write_text(
        POLICY.format(what="pass").replace(
            "return silent", "assert os.getpid() != int(os.environ['DRIVER'])\n    return silent"
        )
    )
    text = CAMPAIGN.replace("worked", "'mine.py:decide'").replace("{count: 6}", "{count: 1}")
    assert sortie.campaign(write(tmp_path, text), out=tmp_path / "a", workers=0).failed == 0
