"""A view on which a policy fails, kept as JSON and as a scenario that shows it to the policy in flight."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sortie.policies.checks import check_directives
from sortie.policies.contract import PHASE_NAMES, Directive, FleetView, Policy, PolicyError, TaskPhase
from sortie.policies.verification.kit.age_rule import raised_part
from sortie.policies.verification.kit.single_view import RepeatableView
from sortie.policies.verification.kit.views import to_json
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie

SHOWN_AT_PERIODS = 5
"""By then every drone has heard every other."""


def replay_scenario(
    rule: str,
    complaint: str,
    policy: str,
    params: Mapping[str, Any],
    view: FleetView,
    *,
    invariant: str = "",
    raised_age_s: Mapping[int, float] | None = None,
) -> Scenario:
    """A short sortie in which the view's ego decides once on the view (then on the older one), and must not fail.

    Args:
        rule: what is broken, in words.
        complaint: how.
        policy: the policy's name or `file.py:function`.
        params: its parameters.
        view: the counterexample.
        invariant: the line that it breaks, if that is what it breaks.
        raised_age_s: the ages of a second, older view, where the two together break the rule.

    Returns:
        The scenario; its one expectation fails, or the flight stops with the contract's error, until the policy is
        mended.
    """
    period_s, ego = view.period_s, view.ego
    views = [view] if raised_age_s is None else [view, view._replace(age_s=dict(raised_age_s))]
    me = view.me
    phase = "search" if me is None else PHASE_NAMES[TaskPhase(me.task_phase)]
    return showing(
        rule,
        complaint,
        views,
        {
            "name": policy,
            "params": dict(params),
            "dwell_s": 0,
            "invariants": invariant,
            "replays": [
                {"at_s": period_s * (SHOWN_AT_PERIODS + k), "drone": ego, "view": to_json(v)}
                for k, v in enumerate(views)
            ],
        },
        duration_s=period_s * (SHOWN_AT_PERIODS + 5),
        mission={"phases": [{"phase": phase if phase in ("transit", "search", "track", "return") else "search"}]},
        context={"rate_hz": 1 / period_s},
    )


def showing(
    rule: str, complaint: str, views: Sequence[FleetView], policy: Mapping[str, Any], **sections: Any
) -> Scenario:
    """A sortie in which a policy section shows views to a drone; it must break no invariant."""
    return Scenario.model_validate(
        {
            "name": slug(rule),
            "description": f"{rule}: {complaint}"[:2000],
            "fleet": {"drones": max(max(v.ego, *v.descriptors) for v in views) + 1, "formation": {"shape": "grid"}},
            "perception": {"detector": "none"},
            "policy": policy,
            "expect": [{"metric": "policies.invariant_violations", "equals": 0, "because": rule}],
            **sections,
        }
    )


def slug(rule: str) -> str:
    """A rule as a name of files and scenarios. A long one is cut, and ends with a digest of all of it."""
    whole = re.sub(r"[^a-z0-9]+", "_", rule.lower()).strip("_") or "rule"
    return whole if len(whole) <= 60 else f"{whole[:51]}_{hashlib.sha256(rule.encode()).hexdigest()[:8]}"


def unused(folder: Path, stem: str) -> Path:
    """A free path in the folder for a `.json` and a `.yaml` file; the folder is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [stem, *(f"{stem}_{k}" for k in range(2, 1000))]
    return next(
        folder / name for name in names if not any((folder / f"{name}{e}").exists() for e in (".json", ".yaml"))
    )


def raised_ages(policy: Policy, view: FleetView) -> dict[int, float] | None:
    """Ages above the view's at which the policy decides more than on the view, or gives no directives at all.

    None where the few tried show none, and where the policy gives no directives on the view itself.
    """
    try:
        before = _decided(policy, view)
    except Exception:  # the view alone shows the fault
        return None
    for older in RepeatableView(plain=view).older():
        try:
            raised = raised_part(before, _decided(policy, older))
        except Exception as error:
            raised = f"raises {type(error).__name__}"
        if raised is not None:
            return dict(older.age_s)
    return None


def _decided(policy: Policy, view: FleetView) -> list[Directive]:
    directives = policy(view)
    check_directives(directives, view)
    return list(directives)


def shows_in_flight(scenario: Scenario) -> bool:
    """Whether the scenario's flight stops with the contract's error or breaks an invariant. Large fleets are not flown: it takes minutes."""
    if scenario.fleet.drones > LISTED_IDS:
        return False
    try:
        record = run_sortie(scenario)
    except PolicyError:
        return True
    except Exception:  # what is no directive trips the audit before the contract names it: kept as a view alone
        return False
    return record.totals["invariant_violations"] > 0
