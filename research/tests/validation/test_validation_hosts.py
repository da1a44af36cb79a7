"""The recipes of docs/guide/cluster, and campaigns on hosts with addresses of their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from research.validation import hosts

# --- hosts ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_campaign_survives_a_host_that_is_cut_off(tmp_path: Path) -> None:
    """Its other half is flown by a host that joins; the table is that of one worker on this machine."""
    pytest.importorskip("distributed")
    if reason := hosts.why_not():
        pytest.skip(reason)
    hosts.prepare(tmp_path, runs=300)
    outcome = hosts.fly("cut", 300, hosts.LEAST_TIMEOUT_S, tmp_path)
    assert outcome.passed, outcome
    assert not any(f"-{name}" in hosts._ip("netns", "list") for name in map(hosts._space, hosts.HOSTS))


@pytest.mark.parametrize(
    ("platform", "command", "user", "reason"),
    [
        ("darwin", "/sbin/ip", 0, "hosts.py cannot run here: it needs Linux and the command ip (iproute2)"),
        ("linux", None, 0, "hosts.py cannot run here: it needs Linux and the command ip (iproute2)"),
        ("linux", "/sbin/ip", 1000, "hosts.py cannot run here: only root may make network namespaces"),
    ],
)
def test_where_there_can_be_no_hosts_one_line_says_why(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    platform: str, command: str | None, user: int, reason: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(hosts.sys, "platform", platform)
    monkeypatch.setattr(hosts.shutil, "which", lambda name: command)
    monkeypatch.setattr(hosts.os, "geteuid", lambda: user)
    monkeypatch.setattr(hosts.sys, "argv", ["hosts.py"])
    assert hosts.main() == 2
    assert capsys.readouterr() == ("", f"{reason}\n")


@pytest.mark.parametrize(
    ("changed", "passed"),
    [
        ({}, True), ({"trial": "desk"}, False), ({"trial": "desk", "code": 2}, True), ({"code": None}, False), ({"code": 1}, False),
        ({"said": ["no workers"]}, True), ({"said": ["no workers", "again"]}, False), ({"said": ["Traceback (most"]}, False),
        ({"rows": 0}, False), ({"rows": 10}, False), ({"same": False}, False),
    ],
)  # fmt: skip
def test_a_trial_fails_by_each_of_its_rules(changed: dict[str, Any], passed: bool) -> None:
    good: dict[str, Any] = {"trial": "cut", "code": 0, "said": [], "rows": 4, "runs": 10, "same": True, "seconds": 1.0}
    assert hosts.Outcome(**good | changed).passed == passed
