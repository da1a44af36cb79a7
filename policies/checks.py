"""The checks of what a policy returns, where it enters the fleet: each is against the bounds of the contract."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Mapping, Sequence
from itertools import compress

import numpy as np

from sortie.policies.contract import (
    DIRECTIVE_BOUNDS,
    MAX_REASON,
    MAX_REPOSITION_M,
    Directive,
    Disc,
    FleetView,
    PolicyError,
    Reposition,
    Representation,
)

_MAX_RUNG, _MAX_RHO, _MAX_RATE_HZ, _MAX_DEADLINE_S, _MAX_WEIGHT, _MAX_DUTY = (b.high for b in DIRECTIVE_BOUNDS.values())
_PLAIN_NUMBERS = frozenset({float, int})
_WHOLE = (int, np.integer)


class StandIn:
    """What stands for a number while a proof runs a policy; the checks take it for one."""

    __slots__ = ()


_NUMBERS = (float, int, np.floating, np.integer, np.bool_, StandIn)
_FAR_M = 3.4028234663852886e38
"""The largest 32-bit float. The wire carries a disc in 32-bit floats."""


def check_directives(directives: Sequence[Directive], view: FleetView) -> None:
    """Check a policy's output against the contract, once, where it enters the fleet.

    Raises:
        PolicyError: naming the directive, the field and what it must be.
    """
    if _is_plainly_valid(directives, view):
        return
    if type(directives) is not list and type(directives) is not tuple:
        raise PolicyError(f"a policy returns a list or a tuple of directives, got {type(directives).__name__}")
    seen = {view.ego}
    for d in directives:
        fault = _find_fault(d, view, seen)
        if fault is not None:
            raise PolicyError(fault)
        seen.add(d.destination)


def differing(
    before: Sequence[Directive], directives: Sequence[Directive], view: FleetView, linked: Mapping[int, Directive]
) -> list[Directive] | None:
    """Those of a policy's directives that are other objects than in its answer before; most of the time it repeats itself.

    Args:
        before: the answer before, which was checked by a view of the same peers or some of them.
        directives: the answer now.
        view: that the answer now was given to.
        linked: the answer before, by destination.

    Returns:
        The directives that are new, checked against the contract; None where the whole answer must be checked.
    """
    if type(directives) is not tuple and type(directives) is not list:
        return None
    changed, were = directives, before
    if len(before) == len(directives):
        moved = list(map(operator.is_not, directives, before))
        changed, were = list(compress(directives, moved)), list(compress(before, moved))
    gone = dict(zip(map(id, were), were, strict=True))
    new = [d for d in changed if gone.pop(id(d), None) is None]  # others have only another place in the answer
    if not _is_plainly_valid(new, view):
        return None
    renewed = {d.destination for d in gone.values()}
    added = {d.destination for d in new}
    # no link lost its directive, and none has two
    return new if renewed <= added and linked.keys().isdisjoint(added - renewed) else None


def _is_plainly_valid(directives: Sequence[Directive], view: FleetView) -> bool:
    """Whether all is valid and of the plain types that nearly every policy uses. Fast: it runs thousands of times a sortie."""
    ego, peers, seen, sound_roi = view.ego, view.descriptors, {view.ego}, None
    add = seen.add
    kind = type(directives)
    if kind is not list and kind is not tuple:
        return False
    try:
        links = len(directives)
        for d in directives:
            if type(d) is not Directive:
                return False
            source, destination, rung, rho, roi, rate_hz, deadline_s, weight, duty_percent, reason = d
            if not (
                source is ego  # ids are small ints, of which Python has one each
                and destination.__class__ is int
                and destination in peers
                and (rung.__class__ is Representation or (rung.__class__ is int and 0 <= rung <= _MAX_RUNG))
                and type(rho) in _PLAIN_NUMBERS
                and type(rate_hz) in _PLAIN_NUMBERS
                and type(deadline_s) in _PLAIN_NUMBERS
                and type(weight) in _PLAIN_NUMBERS
                and 0.0 <= rho <= _MAX_RHO
                and 0.0 <= rate_hz <= _MAX_RATE_HZ
                and 0.0 <= deadline_s <= _MAX_DEADLINE_S
                and 0.0 <= weight <= _MAX_WEIGHT
                and duty_percent.__class__ is int
                and 0 <= duty_percent <= _MAX_DUTY
                and reason.__class__ is str
                and len(reason) <= MAX_REASON
            ):
                return False
            if roi is not sound_roi and roi is not None:
                x_m, y_m, radius_m = roi
                if not (
                    roi.__class__ is Disc
                    and type(x_m) in _PLAIN_NUMBERS
                    and type(y_m) in _PLAIN_NUMBERS
                    and type(radius_m) in _PLAIN_NUMBERS
                    and -_FAR_M <= x_m <= _FAR_M
                    and -_FAR_M <= y_m <= _FAR_M
                    and 0.0 < radius_m <= _FAR_M
                ):
                    return False
                sound_roi = roi  # the next links mostly have the same
            add(destination)
    except Exception:  # no directive, or a field that is no number
        return False
    return len(seen) == links + 1  # no link twice, none to the ego itself


def check_reposition(request: object, view: FleetView) -> None:
    """Check what a viewpoint returned against the contract, once, where it enters the fleet.

    Raises:
        PolicyError: naming the drone, the field and what it must be.
    """
    if request is None:
        return
    if not isinstance(request, Reposition):
        raise PolicyError(f"a viewpoint returns Reposition or None, got {type(request).__name__}")
    where, me = f"reposition of drone {view.ego}", view.me
    if me is None:
        raise PolicyError(f"{where}: the view has no descriptor of it, must be None")
    if fault := _reason_fault(request.reason):
        raise PolicyError(f"{where}: {fault}")
    away_m = []
    for name, value, here_m in (("x_m", request.x_m, me.position_m[0]), ("y_m", request.y_m, me.position_m[1])):
        if not isinstance(value, _NUMBERS):
            raise PolicyError(f"{where}: {name} is {value!r}, must be a number")
        away_m.append(math.fabs(value - here_m))
    far_m = math.hypot(*away_m)
    if not far_m <= MAX_REPOSITION_M:  # also catches NaN
        raise PolicyError(f"{where}: {far_m:.1f} m from the drone, must be at most {MAX_REPOSITION_M:g} m")


def find_wrong_type(d: object) -> str | None:
    """The first field of a directive that is of a wrong type, as an error text; None if all types are right.

    Example:
        >>> find_wrong_type(Directive(0, 1, rho="much"))
        "directive 0→1: rho is 'much', must be in [0, 1], a number"
    """
    if not isinstance(d, Directive):
        return f"a policy returns Directive, got {type(d).__name__}"
    wrong = _wrong_field(d)
    return None if wrong is None else f"{_where(d)}: {wrong}"


def _wrong_field(d: Directive) -> str | None:
    for name in ("source", "destination"):
        value = getattr(d, name)
        if not isinstance(value, _WHOLE) or isinstance(value, bool):
            return f"{name} is {value!r}, must be a drone's id, a whole number"
    for name, (high, kind) in DIRECTIVE_BOUNDS.items():
        value = getattr(d, name)
        if not isinstance(value, _NUMBERS if kind == "a number" else _WHOLE):
            bounds = "" if name == "representation" else f"in [0, {high:g}], "
            return f"{name} is {value!r}, must be {bounds}{kind}"
    if not (d.roi is None or isinstance(d.roi, Disc)):
        return f"roi is {d.roi!r}, must be a Disc or None"
    for name, value in () if d.roi is None else d.roi._asdict().items():
        if not isinstance(value, _NUMBERS):
            return f"roi.{name} is {value!r}, must be a number"
    return _reason_fault(d.reason)


def _find_fault(d: Directive, view: FleetView, seen: set[int]) -> str | None:
    """What is wrong with a directive; None if it is valid and only has rarer types, such as numpy's."""
    wrong = find_wrong_type(d)
    if wrong is not None:
        return wrong
    wrong = _wrong_value(d, view, seen)
    return None if wrong is None else f"{_where(d)}: {wrong}"


def _wrong_value(d: Directive, view: FleetView, seen: set[int]) -> str | None:
    if d.source != view.ego:
        return f"source is {d.source}, must be the ego {view.ego}"
    if d.destination == view.ego or d.destination not in view.descriptors:
        return f"destination {d.destination} is not a peer in the view {list(view.peers)}"
    for name, bound in DIRECTIVE_BOUNDS.items():
        wrong = bound.breaks(name, getattr(d, name))
        if wrong is not None:
            return wrong
    if d.roi is not None:
        if not d.roi.radius_m > 0:
            return f"roi.radius_m is {d.roi.radius_m!r}, must be > 0"
        for name, value in d.roi._asdict().items():
            if not -_FAR_M <= value <= _FAR_M:
                return f"roi.{name} is {value!r}, must be finite in 32 bits"
    return "second directive for the same link" if d.destination in seen else None


def _where(d: Directive) -> str:
    return f"directive {d.source}→{d.destination}"


_HALF_PAIR = re.compile("[\ud800-\udfff]")


def _reason_fault(reason: object) -> str | None:
    """Why a reason cannot stand in the record; None if it can."""
    if not isinstance(reason, str):
        return f"reason is {reason!r}, must be text"
    if _HALF_PAIR.search(reason):
        return f"reason is {reason!r:.200}, must be text that UTF-8 can write"
    if len(reason) > MAX_REASON:
        return f"reason has {len(reason)} characters, must have at most {MAX_REASON}"
    return None
