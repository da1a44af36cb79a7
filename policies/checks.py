"""The checks of what a policy returns, where it enters the fleet: each is against the bounds of the contract."""

from __future__ import annotations

import math
import operator
import re
import sys
from collections.abc import Mapping, Sequence
from itertools import compress
from numbers import Real
from typing import Any

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
from sortie.scenarios.plugins.user_calls import text_of

_MAX_RUNG, _MAX_RHO, _MAX_RATE_HZ, _MAX_DEADLINE_S, _MAX_WEIGHT, _MAX_DUTY = (b.high for b in DIRECTIVE_BOUNDS.values())
_PLAIN_NUMBERS = frozenset({float, int})
_FAR_M = 3.4028234663852886e38
"""The largest 32-bit float. The wire carries a disc in 32-bit floats."""


def check_directives(directives: Sequence[Directive], view: FleetView) -> None:
    """Check a policy's output against the contract, once, where it enters the fleet.

    Only a list or a tuple of exactly `Directive` is accepted. Anything else may read differently the next time.

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
                and type(rho) in _PLAIN_NUMBERS  # a type of the user's own may compare as it likes
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
                and (reason.isascii() or _reason_fault(reason) is None)
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
    if type(request) is not Reposition:
        raise PolicyError(f"a viewpoint returns Reposition or None, got {type(request).__name__}")
    where, me = f"reposition of drone {view.ego}", view.me
    if me is None:
        raise PolicyError(f"{where}: the view has no descriptor of it, must be None")
    if fault := _reason_fault(request.reason):
        raise PolicyError(f"{where}: {fault}")
    away_m = []
    for name, value, here_m in (("x_m", request.x_m, me.position_m[0]), ("y_m", request.y_m, me.position_m[1])):
        if not _is_honest(value) or not _compares(value, -math.inf, math.inf):
            raise PolicyError(f"{where}: {name} is {_told(value)}, must be a number")
        away_m.append(math.fabs(value - here_m))
    far_m = math.hypot(*away_m)
    if not far_m <= MAX_REPOSITION_M:  # also catches NaN
        raise PolicyError(f"{where}: {far_m:.1f} m from the drone, must be at most {MAX_REPOSITION_M:g} m")


def find_inexact(answer: object) -> str | None:
    """Why a policy's answer may read differently each time, as an error text; None if it cannot.

    Example:
        >>> find_inexact(iter(()))
        'a policy returns a list or a tuple of directives, got tuple_iterator'
    """
    if type(answer) is not list and type(answer) is not tuple:
        return f"a policy returns a list or a tuple of directives, got {type(answer).__name__}"
    for d in answer:
        if type(d) is not Directive:
            return f"a policy returns Directive, got {type(d).__name__}"
        for name, value in zip(Directive._fields, d, strict=True):
            for part in value if type(value) is Disc else (value,):
                if not _is_honest(part):
                    return f"{_where(d)}: {name} is of the policy's own type {type(part).__name__}"
    return None


def find_wrong_type(d: object) -> str | None:
    """The first field of a directive that is of a wrong type, as an error text; None if all types are right."""
    if type(d) is not Directive:
        return f"a policy returns Directive, got {type(d).__name__}"
    wrong = _wrong_field(d)
    return None if wrong is None else f"{_where(d)}: {wrong}"


def _wrong_field(d: Directive) -> str | None:
    for name in ("source", "destination"):
        if not _is_honest(getattr(d, name)) or not _is_id(getattr(d, name)):
            return f"{name} is {_told(getattr(d, name))}, must be a drone's id, a whole number"
    for name, (high, kind) in DIRECTIVE_BOUNDS.items():
        value = getattr(d, name)
        if not _is_honest(value) or not _compares(value, 0.0, high) or (kind != "a number" and not _is_whole(value)):
            bounds = "" if name == "representation" else f"in [0, {high:g}], "
            return f"{name} is {_told(value)}, must be {bounds}{kind}"
    if not (d.roi is None or type(d.roi) is Disc):
        return f"roi is {text_of(d.roi)}, must be a Disc or None"
    for name, value in () if d.roi is None else d.roi._asdict().items():
        if not _is_honest(value) or not _compares(value, -_FAR_M, _FAR_M):
            return f"roi.{name} is {_told(value)}, must be a number"
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
    return f"directive {text_of(d.source, str)}→{text_of(d.destination, str)}"


def _told(value: object) -> str:
    """A value in an error; of a type of the user's own with the type's name, as it may look like a valid one."""
    return text_of(value) if _is_honest(value) else f"{text_of(value)} of the policy's own type {type(value).__name__}"


def _compares(value: Any, low: float, high: float) -> bool:
    """Whether a value can be compared with its bounds and is a number of any type, but no array of one number."""
    try:
        bool(low <= value <= high)
    except Exception:  # whatever a foreign type raises
        return False
    return isinstance(value, _NUMBERS) and not isinstance(value, np.timedelta64)


_NUMBERS = (Real, np.bool_)


_HONEST = frozenset({"builtins", "numpy", "sortie"})


def _is_honest(value: object) -> bool:
    """Whether a value's type is known to compare the same each time: a type of the user's own may not."""
    kind = type(value)
    if kind is float or kind is int or kind is str or value is None:
        return True
    module = kind.__module__
    if type(module) is not str or module.partition(".")[0] not in _HONEST:
        return False
    return getattr(sys.modules.get(module), kind.__name__, None) is kind  # a class may claim to be from any module


_HALF_PAIR = re.compile("[\ud800-\udfff]")


def _reason_fault(reason: object) -> str | None:
    """Why a reason cannot stand in the record; None if it can."""
    if not isinstance(reason, str) or not _is_honest(reason):
        return f"reason is {text_of(reason)}, must be text"
    if _HALF_PAIR.search(reason):
        return f"reason is {reason!r:.200}, must be text that UTF-8 can write"
    if len(reason) > MAX_REASON:
        return f"reason has {len(reason)} characters, must have at most {MAX_REASON}"
    return None


def _is_id(value: Any) -> bool:
    """Whether a value is a whole number and no truth value, which a record cannot keep among ids."""
    return _is_whole(value) and not isinstance(value, bool)


def _is_whole(value: Any) -> bool:
    """Whether a value of an honest type is an integer, as the wire needs it: 2 and numpy's 2, not 2.0."""
    try:
        operator.index(value)
    except TypeError:
        return False
    return True
