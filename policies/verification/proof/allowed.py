"""The plain Python that a proof follows: a walk over a policy's source, which runs nothing.

A proof runs the policy on stand-ins for numbers (`ranges`). A stand-in answers comparisons and arithmetic as a number
does. Python asks objects in many other ways, so a policy is proved only if its source has nothing but what is listed here:

| | |
|---|---|
| functions | plain ones, nested ones and lambdas; those that it reaches in its own file and in files beside it |
| statements | assignments, `if`, `for`, `while`, `match` with values, `return`, `assert`, `raise` |
| calls | what `_BUILTINS`, `math` and `_SORTIES` list, and the policy's own functions |
| fields and methods | `_ATTRIBUTES` |
| at module level | numbers, texts, tuples, and tables that are only looked up; nothing that changes |
| f-strings with values | as a `reason`, or under the name `reason` or `why` on the way to one |

A simple rule that refuses a little more is better here than a clever one: such a policy is no worse, it is tried on drawn
views. Sortie's own policies are not walked.
"""

from __future__ import annotations

import ast
import builtins
import functools
import inspect
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from sortie.policies import contract
from sortie.policies.catalogue import attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Policy, Reposition
from sortie.policies.geometry import footprint_overlap, peers_by_overlap
from sortie.policies.registry import POLICIES
from sortie.policies.verification.subject import function_of
from sortie.scenarios import link_state
from sortie.scenarios.disc import disc_overlap
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.plugins.user_calls import Guarded
from sortie.scenarios.representation import Representation

NO_FILE = "is not a policy of Sortie's nor a function in a file that was named as file.py:function"
_OF_NUMBERS = frozenset({"abs", "float", "int", "max", "min", "round"})
"""What may be called at module level, beside `math` and Sortie's types."""
_BUILTIN_NAMES = (
    "all any bool dict divmod enumerate filter iter len list map next range reversed sorted str sum tuple zip "
    "ValueError KeyError IndexError TypeError RuntimeError AssertionError NotImplementedError"
)
_BUILTINS = _OF_NUMBERS | frozenset(_BUILTIN_NAMES.split())
_ENUMS = (Representation, contract.TaskPhase, contract.Coverage, link_state.LinkState)
_DECORATORS = (contract.looks_from, contract.boxes_across_networks, attached.among_attached)
_FUNCTIONS = (
    *(contract.nothing, contract.nothing_to_all, full_sharing, footprint_overlap, peers_by_overlap, disc_overlap),
    *(plain_sum, link_state.state_of, link_state.is_tried, link_state.probed_mbps, link_state.heard_share),
)
_SORTIES = (Directive, Disc, Reposition, *_ENUMS, *_DECORATORS, *_FUNCTIONS, *POLICIES.values())
_DECIDED = frozenset({*Directive._fields, *Disc._fields, *Reposition._fields})
_METHODS = (
    "append clear copy extend get index insert items join keys pop remove reverse setdefault sort update values name value level _replace attached "
    "full_sharing_maps human_in_region me members peers shares_codes_with shares_features_with counts coverage_corner "
    "goodput_to link_state"
)
_ATTRIBUTES = frozenset({*_METHODS.split(), *_DECIDED, *FleetView._fields, *Descriptor._fields})
_REASONS = frozenset({"reason", "why"})
"""Names of texts with numbers: variables, parameters, and functions that return one."""
_HAND_ON = "Return If For While Match match_case IfExp BoolOp BinOp List Tuple ListComp GeneratorExp Starred JoinedStr"
"""What hands a text on: where one may be a reason, so may the parts."""
_OF_CONSTANTS = "Constant Name Attribute Tuple List Dict UnaryOp BinOp Compare Call"
"""What a constant or a table at module level may be made of."""
_OTHERS = (
    "Assign AnnAssign AugAssign Expr Pass Break Continue Assert Raise MatchValue MatchSingleton MatchOr MatchAs FunctionDef "
    "Lambda arguments arg NamedExpr DictComp comprehension Subscript Slice keyword FormattedValue"
)
_ALLOWED = frozenset(f"{_HAND_ON} {_OF_CONSTANTS} {_OTHERS}".split())
_SIGNS = (ast.expr_context, ast.operator, ast.boolop, ast.unaryop, ast.cmpop)
_WORDS = {"Try": "a try statement", "ClassDef": "a class", "Set": "a set"}
_INSIDE = object()
"""The meaning of everything that is no name of a module."""


class NotAllowed(Exception):
    """The source has more than a proof follows; the message says what, and in which line."""

    def __init__(self, what: str, node: ast.AST) -> None:
        super().__init__(f"{what} in line {getattr(node, 'lineno', 1)}")


def why_not_provable(policy: Policy) -> str:
    """What a policy's source has that no proof follows; empty where a proof may follow it."""
    found = function_of(policy)
    if isinstance(policy, functools.partial) and not all(map(_is_fixed, (*policy.args, *policy.keywords.values()))):
        return "has a parameter that is more than numbers and texts"
    if not isinstance(found, Guarded) or found.source is None:
        return "" if str(getattr(found, "__module__", "")).startswith("sortie.policies.") else NO_FILE
    waiting, done = [_undecorated(found.source.names.get(found.source.name))], list[Any]()
    if not _is_plain(waiting[0]):
        return f"is no plain function ({found.source.name})"
    try:
        while waiting:
            function = waiting.pop()
            if function not in done:
                done.append(function)
                waiting += _Walk(function).reached
    except (NotAllowed, SyntaxError, RecursionError, OSError) as error:
        return str(error)
    return ""


def _undecorated(found: Any) -> Any:
    """The function under Sortie's own decorators."""
    sorties = (contract.__file__, attached.__file__)
    while getattr(getattr(found, "__code__", None), "co_filename", "") in sorties and hasattr(found, "__wrapped__"):
        found = found.__wrapped__
    return found


def _is_plain(found: object) -> bool:
    return isinstance(found, FunctionType) and not found.__closure__


def _is_fixed(value: object) -> bool:
    """Whether a value can never change."""
    if isinstance(value, tuple):
        return all(map(_is_fixed, value))
    return value is None or isinstance(value, Enum | bool | int | float | str | bytes)


def _is_table(value: object) -> bool:
    """Whether a value is a list or a dictionary of values that never change."""
    return isinstance(value, list | dict) and all(map(_is_fixed, value.values() if isinstance(value, dict) else value))


def _is_home(name: str) -> bool:
    return name == "math" or name.partition(".")[0] == "sortie"


def _is_listed(found: Any) -> bool:
    """Whether an object is `math`, Sortie, or one of theirs that a policy may use."""
    is_module = isinstance(found, ModuleType) and _is_home(found.__name__)
    of_math = getattr(found, "__module__", "") == "math" and found.__name__ != "sumprod"
    return is_module or of_math or any(found is known for known in _SORTIES)


def _parsed(path: Path) -> ast.Module:
    return _tree(path.read_bytes())  # the file may have changed since it was last read


@functools.lru_cache(maxsize=64)
def _tree(source: bytes) -> ast.Module:
    return ast.parse(source)


def _is_constant(path: Path, name: str, names: Mapping[str, Any]) -> bool:
    """Whether a file sets a name once, at module level, to an expression of constants, or imports such a name.

    Args:
        path: the file.
        name: the name.
        names: all names of the file with their values; without them, a constant is made of none of these.
    """
    bindings = [node for node in ast.walk(_parsed(path)) if name in _bound_by(node)]
    for node in _parsed(path).body if len(bindings) == 1 else ():
        if all(part is not bindings[0] for part in ast.walk(node)):
            continue
        if isinstance(node, ast.ImportFrom) and isinstance(bindings[0], ast.alias) and node.module:
            beside = path.parent.joinpath(*node.module.split(".")).with_suffix(".py")
            return _is_home(node.module) or (beside.is_file() and _is_constant(beside, bindings[0].name, {}))
        is_set = isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None
        return is_set and _is_of_constants(path, node.value, names)  # type: ignore[attr-defined]
    return False


def _is_of_constants(path: Path, node: ast.expr, names: Mapping[str, Any]) -> bool:
    parts = [part for part in ast.walk(node) if not isinstance(part, _SIGNS)]
    used = {part.id for part in parts if isinstance(part, ast.Name)} - (_OF_NUMBERS - names.keys())
    is_plain = all(type(part).__name__ in _OF_CONSTANTS.split() for part in parts)
    return is_plain and all(_is_listed(names.get(n)) or _is_constant(path, n, names) for n in used)


def _bound_by(node: ast.AST) -> tuple[str, ...]:
    """The names that a part binds by itself."""
    match node:
        case ast.Name(id=name, ctx=ast.Store() | ast.Del()) | ast.arg(arg=name) | ast.MatchAs(name=str(name)):
            return (name,)
        case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
            return (name,)
        case ast.alias(name=name, asname=other):
            return (other or name.partition(".")[0],)
        case ast.Global(names=names):
            return tuple(names)
    return ()


class _Walk:
    """Walks one function at module level, with those in it.

    Raises:
        NotAllowed: it has something that is not listed.
    """

    def __init__(self, function: FunctionType) -> None:
        self._names, self._path = function.__globals__, Path(function.__code__.co_filename)
        self.reached: list[FunctionType] = []
        found = [n for n in _parsed(self._path).body if isinstance(n, ast.FunctionDef) and n.name == function.__name__]
        if len(found) != 1:
            raise NotAllowed(f"is no plain function ({function.__name__})", ast.Pass())
        (node,) = found
        parts = [part for top in (node.args, *node.body) for part in ast.walk(top)]
        self._local = {name for part in parts for name in _bound_by(part)}
        self._only_looked_up = {id(one) for part in parts for one in _looked_up_in(part)}
        for name in sorted(self._local & (self._names.keys() | _BUILTINS)):
            raise NotAllowed(f"gives {name} another meaning", node)
        for decorator in node.decorator_list:
            called = self._meaning(decorator.func if isinstance(decorator, ast.Call) else decorator)
            if not any(called is known for known in _DECORATORS):
                raise NotAllowed(f"has the decorator {ast.unparse(decorator)}", decorator)
        values = (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values())
        for default in (*node.args.defaults, *filter(None, node.args.kw_defaults)):
            if not all(map(_is_fixed, values)) or not _is_of_constants(self._path, default, self._names):
                raise NotAllowed("has a default value that is more than a constant", default)
        for part in node.body:
            self._visit(part, node.name in _REASONS)

    def _meaning(self, node: ast.AST) -> Any:
        """What a name, or a dotted name, of a module means; `_INSIDE` for everything else."""
        if isinstance(node, ast.Attribute):
            owner = self._meaning(node.value)
            if not isinstance(owner, ModuleType) and not any(owner is kind for kind in _ENUMS):
                return _INSIDE
            found = getattr(owner, node.attr, _INSIDE)
            if _is_fixed(found) or _is_listed(found):
                return found
        elif not isinstance(node, ast.Name) or node.id in self._local:
            return _INSIDE
        else:
            is_builtin = node.id in _BUILTINS and node.id not in self._names
            found = getattr(builtins, node.id) if is_builtin else self._names.get(node.id, _INSIDE)
            if is_builtin or _is_listed(found) or _is_plain(_undecorated(found)):
                return found
            if (_is_fixed(found) or _is_table(found)) and _is_constant(self._path, node.id, self._names):
                return found
        raise NotAllowed(f"uses {ast.unparse(node)}", node)

    def _visit(self, node: ast.AST, is_text: bool = False) -> None:
        """Check a part; `is_text` where it becomes a reason, so that it may be a text with numbers."""
        kind = type(node).__name__
        if isinstance(node, _SIGNS):
            return
        if kind not in _ALLOWED:
            raise NotAllowed(f"has {_WORDS.get(kind, kind)}", node)
        visit = getattr(self, f"_{kind.lower()}", None)
        if visit is not None:
            visit(node, is_text)
            return
        if (
            isinstance(node, ast.BinOp)
            and isinstance(node.op, ast.Mod)
            and isinstance(node.left, ast.Constant | ast.JoinedStr)
        ):
            raise NotAllowed("has % on a constant or a text", node)
        hands_on = getattr(node, "name", "") in _REASONS or (is_text and kind in _HAND_ON.split())
        for part in ast.iter_child_nodes(node):
            self._visit(part, hands_on)

    def _assign(self, node: ast.Assign | ast.AnnAssign | ast.AugAssign, _: bool) -> None:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        are_reasons = all(isinstance(target, ast.Name) and target.id in _REASONS for target in targets)
        for part in (*targets, node.value):
            if part is not None:
                self._visit(part, are_reasons)

    _annassign = _augassign = _assign

    def _formattedvalue(self, node: ast.FormattedValue, is_text: bool) -> None:
        if not is_text or node.conversion != -1:
            raise NotAllowed("uses an f-string with values for more than `reason` or `why`", node)
        self._visit(node.value, True)
        if node.format_spec is not None:
            self._visit(node.format_spec)

    def _compare(self, node: ast.Compare, _: bool) -> None:
        for op, side in zip(node.ops, node.comparators, strict=True):
            is_single = isinstance(side, ast.Constant) and (side.value is None or isinstance(side.value, bool))
            if isinstance(op, ast.Is | ast.IsNot) and not is_single and not isinstance(self._meaning(side), Enum):
                raise NotAllowed("compares by `is` with more than None, a truth value or an enum", node)
        for side in (node.left, *node.comparators):
            self._visit(side)

    def _name(self, node: ast.Name, is_text: bool) -> None:
        if node.id in _REASONS and not is_text:
            raise NotAllowed(f"uses {node.id} for more than a reason", node)
        found = self._meaning(node)
        if found is str or found is sum or (_is_table(found) and id(node) not in self._only_looked_up):
            raise NotAllowed(f"hands on {node.id}", node)
        if isinstance(found, FunctionType) and not _is_listed(found):
            self.reached.append(_undecorated(found))

    def _attribute(self, node: ast.Attribute, is_text: bool) -> None:
        if not isinstance(node.ctx, ast.Load):
            raise NotAllowed(f"sets {ast.unparse(node)}", node)
        if self._meaning(node) is not _INSIDE:
            return
        if node.attr not in _ATTRIBUTES or (node.attr == "reason" and not is_text):
            raise NotAllowed(f"uses .{node.attr}", node)
        self._visit(node.value)

    def _call(self, node: ast.Call, is_text: bool) -> None:
        found, method = self._meaning(node.func), getattr(node.func, "attr", "")
        if found is sum and not (node.args and isinstance(node.args[0], ast.GeneratorExp | ast.ListComp)):
            raise NotAllowed("adds with sum(…) in place of sortie.scenarios.plain_sum.plain_sum", node)
        if found is str and not is_text:
            raise NotAllowed("uses str(…) for more than a reason", node)
        if found is not sum and found is not str:
            self._visit(node.func, is_text)
        is_error = isinstance(found, type) and issubclass(found, Exception)
        takes_texts = is_error or (is_text and (found is str or method == "join"))
        named = list[str]()
        if isinstance(found, FunctionType) or any(found is known for known in _SORTIES):
            named = list(inspect.signature(found).parameters)
        if any(isinstance(part, ast.Starred) for part in node.args):
            named = []
        for place, part in enumerate(node.args):
            self._visit(part, takes_texts or (place < len(named) and named[place] in _REASONS))
        for keyword in node.keywords:
            if keyword.arg is None or (method == "_replace" and keyword.arg not in _DECIDED):
                raise NotAllowed(f"hands {keyword.arg or '**'} to a function", node)
            self._visit(keyword.value, keyword.arg in _REASONS)


def _looked_up_in(node: ast.AST) -> list[ast.expr]:
    """The parts of which nothing but items is used: they may be tables."""
    match node:
        case ast.Subscript(value=part, ctx=ast.Load()) | ast.For(iter=part) | ast.comprehension(iter=part):
            return [part]
        case ast.Attribute(value=part, attr="get" | "items" | "keys" | "values"):
            return [part]
        case ast.Compare(comparators=parts):
            return parts
    return []
