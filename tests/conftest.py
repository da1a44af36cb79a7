"""Options of the suite."""

from __future__ import annotations

import functools
import os
import signal
from pathlib import Path

import pytest
import typer.main
import typer.testing
from hypothesis import HealthCheck, settings

# torch's threads wait in a busy loop by themselves, which takes the cores from other workers; read when torch is loaded
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# typer reads all commands of the app anew at each call in this process, which takes longer than most of the calls
typer.main.get_command = typer.testing._get_command = functools.cache(typer.main.get_command)

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # begun in the background: children would ignore Ctrl-C as well
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A deadline and the check of slow draws are timed assertions: they fail on a busy machine alone.
settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.register_profile("same", settings.get_profile("explore"), derandomize=True)
settings.load_profile("same")  # the same examples in each run; `make nightly` explores others


NIGHTLY = (
    "api/test_install.py", "api/test_without_extras.py", "benchmarks", "fuzz", "research/benchmark",
    "perception/network/test_perception_codebook.py", "perception/network/test_perception_fine.py",
    "perception/recordings/test_perception_uav3d.py",
    "perception/recordings/test_perception_unpickle.py", "research/flip",
    "perception/surrogate/test_perception_surrogate_calibrate.py",
    "perception/surrogate/test_perception_surrogate_correlation.py",
    "perception/surrogate/test_perception_surrogate_shared_false_positives.py", "research/train",
    "policies/verification/test_policies_corpus.py", "policies/verification/test_policies_generated.py",
    "policies/verification/test_policies_hidden.py", "policies/verification/test_policies_large_views.py",
    "policies/verification/test_policies_solver.py", "policies/verification/test_policies_time_of_drawn_views.py",
    "sim/campaign/test_sim_campaign_by_torch.py", "sim/campaign/test_sim_campaign_cluster.py",
    "sim/campaign/test_sim_campaign_user_code.py", "sim/check/test_sim_over_time.py", "sim/cli/test_sim_cli_bench.py",
    "sim/cli/test_sim_supervised.py", "sim/engine/test_sim_combinations.py", "sim/engine/test_sim_scoring_times.py",
    "sim/live/test_sim_live_members.py", "sim/live/test_sim_live_watchdog.py", "sim/ranking", "sim/studies",
    "site", "validation",
)  # fmt: skip
"""Slow tests of what rarely breaks. `make test` does not even import them; `make nightly` runs them."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out `NIGHTLY` where slow tests are left out."""
    is_nightly = collection_path.relative_to(Path(__file__).parent).as_posix() in NIGHTLY
    return True if is_nightly and config.option.markexpr == "not slow" else None


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update-golden", action="store_true", help="Write golden outcomes anew instead of comparing.")
