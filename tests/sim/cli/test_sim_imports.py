"""What a sortie loads: a command's user waits for it, and so does every worker of a campaign."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {"torch", "numba", "scipy.stats", "scipy.signal", "scipy.interpolate", "networkx", "rerun", "matplotlib"}
"""Each takes from a fifth of a second to some seconds."""


@pytest.mark.parametrize("detector", ["none", "surrogate"])
def test_flying_without_the_network_loads_nothing_heavy(detector: str) -> None:
    fly = (
        "import sys; from sortie.scenarios.reading.load import load; from sortie.sim.engine.sortie import run_sortie\n"
        f"run_sortie(load('track_target', ['perception.detector={detector}', 'duration_s=2', "
        "'mission.phases=[{at_s: 0, phase: search}]']))\n"
        "print(*sys.modules, sep='\\n')"
    )
    loaded = subprocess.run([sys.executable, "-c", fly], capture_output=True, text=True, check=True).stdout
    assert "sortie.sim.engine.sortie" in loaded.split()
    assert HEAVY & set(loaded.split()) == {"numba"}  # the radio's stations are compiled


def test_the_command_line_loads_nothing_heavy() -> None:
    start = "import sys, sortie.sim.cli.app; print(*sys.modules, sep='\\n')"
    loaded = subprocess.run([sys.executable, "-c", start], capture_output=True, text=True, check=True).stdout
    assert "sortie.sim.cli.fly" in loaded.split()
    assert HEAVY & set(loaded.split()) == set()
