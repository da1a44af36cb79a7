"""Fleet views for testing a policy: drawn from a seed, some at the constants of a policy; written as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from random import Random
from typing import Any

from sortie.policies.contract import (
    AGENT_IDS,
    COVERAGE_BYTES,
    DETACHED_AFTER_PERIODS,
    PHASE_NAMES,
    PHASE_OF,
    Descriptor,
    Disc,
    FleetView,
    Roster,
    TaskPhase,
)
from sortie.scenarios.disc import LISTED_IDS, LISTED_MEMBERS
from sortie.scenarios.errors import SortieError
from sortie.scenarios.link_state import PROBED_MBPS, SILENT_MBPS
from sortie.scenarios.schema import Scenario, Section
from sortie.scenarios.schema.base import MOST_DRONES

MAX_DRONES = 20
AT_CONSTANTS = 3
"""Every third drawn view lies at the constants of the policy that it is for."""


def _most(section: type[Section], field: str) -> Any:
    """The upper bound of a scenario's field."""
    return next(bound.le for bound in section.model_fields[field].metadata if hasattr(bound, "le"))


LARGEST = MOST_DRONES
"""The largest fleet of a scenario."""
LONGEST_S = float(_most(Scenario, "duration_s"))
"""The longest sortie."""
GONE = "detached_after_periods"
OTHER_CODEBOOK = "0" * 14
"""A digest that is not the fleet's common one: 7 bytes, as a descriptor has them."""

_SPECIAL_SOC = (0.0, 0.05, 0.2999, 0.3, 0.5, 0.5999, 0.6, 1.0)
_SPECIAL_GOODPUT_MBPS = (0.0, SILENT_MBPS, PROBED_MBPS, 0.01, 4.99, 5.0, 50.0, 600.0, 1e5)
_SPECIAL_AGE_PERIODS = (0.0, 1.0, 3.0, 3.1, 10.0, 10.1, 600.0)
_SHARES = ("battery_soc", "cpu_headroom", "gpu_headroom")


class ViewError(SortieError):
    """A file that is not a valid view; the message names the field."""


# --- drawing -------------------------------------------------------------------------------------


def draw_view(seed: int, number: int, drones: int | None = None, reach: float | None = None) -> FleetView:
    """View `number` of a seed: 1 to 20 drones if not said otherwise, some never heard, some stale, anywhere, in any state.

    Half of all numbers are drawn uniformly. The other half are values at which rules often change their decision.

    Args:
        seed: of all its views.
        number: which one.
        drones: the size of the fleet; left out, it is drawn. In one of more than `LISTED_IDS` every drone has a roster.
        reach: the chance that the ego has heard each other drone, 0 … 1; left out, it is drawn.
    """
    rng = Random(f"view {seed} {number}")  # noqa: S311
    drawn = rng.randint(1, MAX_DRONES if rng.random() < 0.5 else 5)
    n = drawn if drones is None else drones
    ego = rng.randrange(n)
    drawn_reach = rng.choice((1.0, 0.7))
    reach = drawn_reach if reach is None else reach
    heard = [i for i in range(n) if i == ego or rng.random() < reach]
    rng.shuffle(heard)
    period_s = rng.choice((0.1, 0.2, 1.0))
    spread_m = rng.choice((0.0, 30.0, 100.0, 2000.0))
    listed = n if n <= LISTED_IDS else 1
    descriptors = {i: _draw_descriptor(rng, i, listed, spread_m) for i in heard}
    age_s = {i: period_s * _mixed(rng, 0.0, 15.0, _SPECIAL_AGE_PERIODS) for i in heard}
    if rng.random() < 0.25:  # two makes of drone in one fleet
        descriptors = {i: d._replace(feature_space=rng.choice(("", "other"))) for i, d in descriptors.items()}
    if n > LISTED_IDS:
        descriptors = {i: _with_members(rng, d, heard, n) for i, d in descriptors.items()}
    elif rng.random() < 0.25:  # all agree who is a member, heard by the ego or not
        members = tuple(i for i in range(n) if i in descriptors or rng.random() < 0.5)
        descriptors = {i: d.with_roster(Roster(rng.randrange(9), members)) for i, d in descriptors.items()}
    if rng.random() < 0.25:  # and some codes are of another codebook
        descriptors = {i: d._replace(codebook=rng.choice(("", OTHER_CODEBOOK))) for i, d in descriptors.items()}
    gone_after = rng.choice((4.0, 20.0, 1000.0)) if rng.random() < 0.25 else DETACHED_AFTER_PERIODS
    return FleetView(ego, period_s, descriptors, age_s, gone_after)


def draw_views(seed: int, count: int, constants: Iterable[float] = ()) -> Iterator[FleetView]:
    """The first `count` views of a seed; every `AT_CONSTANTS`th has numbers at these constants, if there are any."""
    known = sorted(set(constants))
    for number in range(count):
        view = draw_view(seed, number)
        yield move_to_constants(view, known, f"{seed} {number}") if known and number % AT_CONSTANTS == 0 else view


def move_to_constants(view: FleetView, constants: Sequence[float], key: str) -> FleetView:
    """The view with some of its numbers at constants, or one float beside them.

    Args:
        view: the view.
        constants: a policy's own, ascending.
        key: draws which numbers move.
    """
    rng = Random(f"constants {key}")  # noqa: S311

    def near(low: float, high: float) -> float | None:
        known = [c for c in constants if low <= c <= high]
        if not known or rng.random() < 0.3:
            return None
        c = rng.choice(known)
        return min(max(rng.choice((c, c, math.nextafter(c, -math.inf), math.nextafter(c, math.inf))), low), high)

    descriptors, ages_s = dict(view.descriptors), dict(view.age_s)
    egos = [int(c) for c in constants if c in descriptors]
    ego = rng.choice(egos) if egos and rng.random() < 0.3 else view.ego
    if egos and egos[-1] >= MAX_DRONES:  # no other view has such an ego
        ego = egos[-1]
    together = rng.random() < 0.5  # of all drones, or of the ego alone
    for i, d in descriptors.items():
        if i != ego and not together:
            continue
        changed: dict[str, Any] = {field: x for field in _SHARES if (x := near(0, 1)) is not None}
        goodput, age_s, flags, stamp_s = near(0, 1e5), near(0, LONGEST_S), near(0, 255), near(0, LONGEST_S)
        if goodput is not None:
            changed["peer_goodput_mbps"] = (goodput,) * len(d.peer_goodput_mbps)
        if flags is not None and rng.random() < 0.3:
            changed["novelty_flags"] = int(flags)
        if age_s is not None and rng.random() < 0.5:
            ages_s[i] = age_s
        if stamp_s is not None and rng.random() < 0.3:
            changed["stamp_ns"] = round(stamp_s * rng.choice((1, 1e9)))
        descriptors[i] = d._replace(**changed)
    return view._replace(ego=ego, descriptors=descriptors, age_s=ages_s)


def _draw_descriptor(rng: Random, agent_id: int, drones: int, spread_m: float) -> Descriptor:
    x_m, y_m, vx_mps, vy_mps, yaw = (rng.uniform(-1, 1) for _ in range(5))
    region = None
    if rng.random() < 0.5:
        away_m = rng.choice((0.0, 3000.0))  # the region is here, or far from everyone
        region = Disc(spread_m * x_m + away_m, spread_m * y_m, rng.choice((1.0, 32.0, 500.0)))
    return Descriptor(
        stamp_ns=rng.randrange(10**12),
        agent_id=agent_id,
        position_m=(spread_m * x_m, spread_m * y_m, rng.uniform(0, 120)),
        orientation_xyzw=(0.0, 0.0, math.sin(yaw), math.cos(yaw)),
        velocity_mps=(20 * vx_mps, 20 * vy_mps, 0.0),
        footprint_radius_m=rng.choice((0.0, 20.0, 42.0, 100.0)),
        battery_soc=_mixed(rng, 0.0, 1.0, _SPECIAL_SOC),
        cpu_headroom=_mixed(rng, 0.0, 1.0, (0.0, 1.0)),
        gpu_headroom=_mixed(rng, 0.0, 1.0, (0.0, 1.0)),
        peer_goodput_mbps=_draw_goodput_mbps(rng, drones - 1),
        coverage_grid=rng.randbytes(COVERAGE_BYTES) if rng.random() < 0.7 else bytes(COVERAGE_BYTES),
        novelty_flags=rng.randrange(8),
        task_phase=rng.choice(tuple(TaskPhase)),
        region=region,
        priority_target_ids=tuple(rng.randrange(1000) for _ in range(rng.choice((0, 0, 1, 5)))),
    )


def _with_members(rng: Random, d: Descriptor, heard: Sequence[int], drones: int) -> Descriptor:
    """As in a large fleet: with a roster of those in its own earshot, which the ego may not have heard, and their goodputs."""
    most = LISTED_MEMBERS - 1
    others = set(rng.choices(heard, k=rng.choice((0, 8, most))))
    others |= set(rng.choices(range(drones), k=min(most - len(others), 4)))
    members = tuple(sorted({d.agent_id, *others}))
    goodput_mbps = _draw_goodput_mbps(rng, len(members) - 1)
    return d._replace(peer_goodput_mbps=goodput_mbps, roster=Roster(rng.randrange(9), members))


def _draw_goodput_mbps(rng: Random, count: int) -> tuple[float, ...]:
    return tuple([_mixed(rng, 0.0, 600.0, _SPECIAL_GOODPUT_MBPS) for _ in range(count)])


def _mixed(rng: Random, low: float, high: float, special: Sequence[float]) -> float:
    return rng.uniform(low, high) if rng.random() < 0.5 else rng.choice(special)


# --- JSON ----------------------------------------------------------------------------------------


def to_json(view: FleetView) -> str:
    """The view as JSON, one drone on each line; every number can be read back exactly."""
    drones = []
    for i, d in view.descriptors.items():
        fields = d._asdict() | {
            "coverage_grid": d.coverage_grid.hex(),
            "task_phase": PHASE_NAMES[TaskPhase(d.task_phase)],
            "region": None if d.region is None else list(d.region),
            "roster": None if d.roster is None else d.roster._asdict(),
        }
        if not d.codebook:  # as in texts from before there were codes
            del fields["codebook"]
        drones.append(json.dumps({"age_s": view.age_s[i]} | fields))
    inner = ",\n  ".join(drones)
    usual = view.detached_after_periods == DETACHED_AFTER_PERIODS
    gone = "" if usual else f'"{GONE}": {view.detached_after_periods!r}, '
    return (
        f'{{"ego": {view.ego}, "period_s": {view.period_s!r}, {gone}"drones": ['
        + (f"\n  {inner}\n" if inner else "")
        + "]}\n"
    )


def from_json(text: str) -> FleetView:
    """The view that `to_json` wrote.

    Raises:
        ViewError: naming the field that is missing or wrong.
    """
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ViewError(f"not JSON: {error}") from error
    if not isinstance(data, dict) or not isinstance(data.get("drones"), list):
        raise ViewError("a view is an object with ego, period_s and a list of drones")
    descriptors: dict[int, Descriptor] = {}
    age_s: dict[int, float] = {}
    for k, entry in enumerate(data["drones"]):
        if not isinstance(entry, dict):
            raise ViewError(f"drones[{k}] must be an object")
        descriptor = _descriptor(entry, f"drones[{k}]")
        if descriptor.agent_id in descriptors:
            raise ViewError(f"drones[{k}].agent_id is {descriptor.agent_id}, which another drone has already")
        descriptors[descriptor.agent_id] = descriptor
        age_s[descriptor.agent_id] = _number(entry, "age_s", f"drones[{k}]", 0.0)
    ego = _number(data, "ego", "view", 0, AGENT_IDS - 1)
    period_s = _number(data, "period_s", "view", 0.0)
    if period_s == 0:
        raise ViewError("view.period_s is 0, must be above 0")
    gone_after = _number({GONE: DETACHED_AFTER_PERIODS} | data, GONE, "view", 0.0)
    return FleetView(int(ego), float(period_s), descriptors, age_s, float(gone_after))


def _descriptor(entry: dict[str, Any], where: str) -> Descriptor:
    try:
        phase = PHASE_OF[str(entry.get("task_phase"))]
    except KeyError as error:
        known = ", ".join(PHASE_OF)
        raise ViewError(f"{where}.task_phase is {entry.get('task_phase')!r}, must be one of {known}") from error
    try:
        grid = bytes.fromhex(entry.get("coverage_grid", ""))
    except (TypeError, ValueError) as error:
        raise ViewError(f"{where}.coverage_grid must be hexadecimal") from error
    if len(grid) != COVERAGE_BYTES:
        raise ViewError(f"{where}.coverage_grid has {len(grid)} bytes, must have {COVERAGE_BYTES}")
    region = entry.get("region")
    x_m, y_m, z_m = _numbers(entry, "position_m", where, 3)
    vx_mps, vy_mps, vz_mps = _numbers(entry, "velocity_mps", where, 3)
    qx, qy, qz, qw = _numbers(entry, "orientation_xyzw", where, 4)
    return Descriptor(
        stamp_ns=int(_number(entry, "stamp_ns", where)),
        agent_id=int(_number(entry, "agent_id", where, 0, AGENT_IDS - 1)),
        position_m=(x_m, y_m, z_m),
        orientation_xyzw=(qx, qy, qz, qw),
        velocity_mps=(vx_mps, vy_mps, vz_mps),
        footprint_radius_m=_number(entry, "footprint_radius_m", where, 0.0),
        battery_soc=_number(entry, "battery_soc", where, 0.0, 1.0),
        cpu_headroom=_number(entry, "cpu_headroom", where, 0.0, 1.0),
        gpu_headroom=_number(entry, "gpu_headroom", where, 0.0, 1.0),
        peer_goodput_mbps=_numbers(entry, "peer_goodput_mbps", where),
        coverage_grid=grid,
        novelty_flags=int(_number(entry, "novelty_flags", where, 0, 255)),
        task_phase=phase,
        region=None if region is None else Disc(*_numbers(entry, "region", where, 3)),
        priority_target_ids=tuple(int(t) for t in _numbers(entry, "priority_target_ids", where)),
        feature_space=_text(entry, "feature_space", where),
        roster=_roster(entry, where),
        codebook=_text(entry, "codebook", where) if "codebook" in entry else "",
    )


def _roster(entry: dict[str, Any], where: str) -> Roster | None:
    value = entry.get("roster")
    if value is None:
        return None
    if not isinstance(value, dict):
        raise ViewError(f"{where}.roster is {value!r}, must be an object with epoch and members, or null")
    members = tuple(int(i) for i in _numbers(value, "members", f"{where}.roster"))
    ascending = members == tuple(sorted(set(members)))
    if not ascending or entry["agent_id"] not in members or len(entry["peer_goodput_mbps"]) != len(members) - 1:
        wanted = "ascending ids, the drone's own among them, one more than peer_goodput_mbps has entries"
        raise ViewError(f"{where}.roster.members is {list(members)}, must be {wanted}")
    return Roster(int(_number(value, "epoch", f"{where}.roster", 0)), members)


def _number(entry: Mapping[str, Any], name: str, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    value = entry.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ViewError(f"{where}.{name} is {value!r}, must be a number")
    if not low <= value <= high:
        raise ViewError(f"{where}.{name} is {value!r}, must be in [{low:g}, {high:g}]")
    return value


def _text(entry: Mapping[str, Any], name: str, where: str) -> str:
    value = entry.get(name, "")
    if not isinstance(value, str):
        raise ViewError(f"{where}.{name} is {value!r}, must be text")
    return value


def _numbers(entry: Mapping[str, Any], name: str, where: str, length: int | None = None) -> tuple[float, ...]:
    values = entry.get(name)
    if not isinstance(values, list) or (length is not None and len(values) != length):
        raise ViewError(f"{where}.{name} is {values!r}, must be a list" + (f" of {length} numbers" if length else ""))
    return tuple(_number({name: v}, name, where) for v in values)
