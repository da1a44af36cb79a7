"""Sortie simulates fleets of drones that share what they see: context, policy, real bytes and accuracy on one clock.

    import sortie

    run = sortie.fly("track_target", {"duration_s": 20, "perception.detector": "surrogate"})
    run.outcome["ap50"]["full_scene"]        # what the fleet saw
    run.outcome["bytes"]["data_sent"]        # what it sent for it

Everything here is loaded when it is first used. What is not in `__all__` is private and may change.
"""

from __future__ import annotations

TYPE_CHECKING = False  # typing's own takes a while to import
if TYPE_CHECKING:
    from typing import Any

    from sortie._api import (
        CampaignResult,
        Comparison,
        campaign,
        check,
        compare,
        env,
        fly,
        load,
        open_campaign,
        open_run,
        replay,
    )
    from sortie._rank import Ranking, rank
    from sortie._run import Run
    from sortie.policies.contract import (
        Descriptor,
        Directive,
        Disc,
        FleetView,
        LinkState,
        Policy,
        PolicyError,
        Reposition,
        Representation,
        TaskPhase,
        boxes_across_networks,
        looks_from,
    )
    from sortie.scenarios.errors import SortieError
    from sortie.scenarios.reading.nodes import ScenarioError
    from sortie.scenarios.schema import Scenario
    from sortie.sim.folders import RunError
    from sortie.sim.studies.replayed import Replay

    __version__: str

__all__ = [
    "load",
    "fly",
    "compare",
    "replay",
    "campaign",
    "check",
    "rank",
    "env",
    "open_run",
    "open_campaign",
    "Run",
    "Comparison",
    "Replay",
    "CampaignResult",
    "Ranking",
    "Scenario",
    "Policy",
    "FleetView",
    "Descriptor",
    "Directive",
    "Representation",
    "Disc",
    "TaskPhase",
    "LinkState",
    "Reposition",
    "looks_from",
    "boxes_across_networks",
    "SortieError",
    "ScenarioError",
    "PolicyError",
    "RunError",
    "__version__",
]

_HOMES = {
    "sortie._api": (
        "load",
        "fly",
        "compare",
        "replay",
        "campaign",
        "check",
        "env",
        "open_run",
        "open_campaign",
        "Comparison",
        "CampaignResult",
    ),
    "sortie._rank": ("rank", "Ranking"),
    "sortie._run": ("Run",),
    "sortie.policies.contract": (
        "Policy",
        "FleetView",
        "Descriptor",
        "Directive",
        "Representation",
        "Disc",
        "TaskPhase",
        "LinkState",
        "Reposition",
        "looks_from",
        "boxes_across_networks",
        "PolicyError",
    ),
    "sortie.scenarios.errors": ("SortieError",),
    "sortie.scenarios.reading.nodes": ("ScenarioError",),
    "sortie.scenarios.schema": ("Scenario",),
    "sortie.sim.folders": ("RunError",),
    "sortie.sim.studies.replayed": ("Replay",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("sortie-sim")
    elif name in _HOME_OF:
        from importlib import import_module

        value = getattr(import_module(_HOME_OF[name]), name)
    else:
        raise AttributeError(f"module 'sortie' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
