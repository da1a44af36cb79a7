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

Everything else is no fault: such a policy is tried on drawn views. Sortie's own policies are not walked.
"""

from __future__ import annotations

import ast
import builtins
import functools
import importlib
import inspect
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

from sortie.policies import contract
from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Policy, Reposition
from sortie.policies.geometry import footprint_overlap, peers_by_overlap
from sortie.policies.registry import POLICIES
from sortie.policies.verification.shield import Shielded
from sortie.scenarios import link_state
from sortie.scenarios.disc import disc_overlap
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.plugins.user_calls import Guarded
from sortie.scenarios.representation import Representation

NO_FILE = "is not a policy of Sortie's nor a function in a file that was named as file.py:function"
_BUILTINS = frozenset(
    [
        "abs",
        "all",
        "any",
        "bool",
        "dict",
        "divmod",
        "enumerate",
        "filter",
        "float",
        "int",
        "iter",
        "len",
        "list",
        "map",
        "max",
        "min",
        "next",
        "range",
        "reversed",
        "round",
        "sorted",
        "str",
        "sum",
        "tuple",
        "zip",
        "ValueError",
        "KeyError",
        "IndexError",
        "TypeError",
        "RuntimeError",
        "AssertionError",
        "NotImplementedError",
    ]
)
_ENUMS = (Representation, contract.TaskPhase, contract.Coverage, link_state.LinkState)
_SORTIES: dict[int, Any] = {
    id(known): known
    for known in (
        Directive, Disc, Reposition, *_ENUMS, contract.nothing, contract.nothing_to_all, full_sharing, footprint_overlap,
        peers_by_overlap, disc_overlap, plain_sum, link_state.state_of, link_state.is_tried, link_state.probed_mbps,
        link_state.heard_share, contract.looks_from, contract.boxes_across_networks, among_attached, *POLICIES.values(),
    )
}  # fmt: skip
_DECORATORS = (contract.looks_from, contract.boxes_across_networks, among_attached)
_OF_OBJECTS = (
    "append clear copy extend get index insert items join pop remove reverse setdefault sort update values "  # lists, tables
    "name value level _replace attached full_sharing_maps human_in_region me members peers shares_codes_with "
    "shares_features_with counts coverage_corner goodput_to link_state"
)
_ATTRIBUTES = frozenset({
    *_OF_OBJECTS.split(), *Directive._fields, *Disc._fields, *Reposition._fields, *FleetView._fields, *Descriptor._fields
})  # fmt: skip
_REASONS = frozenset({"reason", "why"})
"""Names of texts with numbers: variables, parameters, and functions that return one."""
_STATEMENTS = (
    ast.Assign, ast.AnnAssign, ast.AugAssign, ast.Delete, ast.For, ast.While, ast.If, ast.Return, ast.Expr, ast.Pass, ast.Break,
    ast.Continue, ast.Assert, ast.Raise, ast.Match, ast.match_case, ast.MatchValue, ast.MatchSingleton, ast.MatchOr, ast.MatchAs,
)  # fmt: skip
_CONSTANTS = (
    ast.Constant, ast.Name, ast.Attribute, ast.Tuple, ast.UnaryOp, ast.BinOp, ast.Compare, ast.IfExp, ast.BoolOp, ast.JoinedStr,
    ast.FormattedValue, ast.Call, ast.expr_context, ast.operator, ast.boolop, ast.unaryop, ast.cmpop,
)  # fmt: skip
"""What a constant at module level may be made of."""
_EXPRESSIONS = (
    *_CONSTANTS, ast.Lambda, ast.NamedExpr, ast.ListComp, ast.DictComp, ast.GeneratorExp, ast.comprehension, ast.Dict, ast.List,
    ast.Subscript, ast.Slice, ast.Starred, ast.keyword,
)  # fmt: skip
_OF_NUMBERS = (abs, min, max, round, int, float, Disc, *_ENUMS)
"""What may be called at module level, beside `math`."""
_WORDS: dict[type[ast.AST], str] = {
    ast.Try: "a try statement", ast.With: "a with statement", ast.ClassDef: "a class", ast.Set: "a set", ast.SetComp: "a set",
    ast.Yield: "yield", ast.YieldFrom: "yield",
}  # fmt: skip
_COMPREHENSIONS = (ast.ListComp, ast.DictComp, ast.GeneratorExp)


class NotAllowed(Exception):
    """The source has more than a proof follows; the message says what, and in which line."""

    def __init__(self, what: str, node: ast.AST | None = None) -> None:
        line = getattr(node, "lineno", 0)
        super().__init__(f"{what} in line {line}" if line else what)


def why_not_provable(policy: Policy) -> str:
    """What a policy's source has that no proof follows; empty where a proof may follow it."""
    found: Any = policy
    while isinstance(found, functools.partial | Shielded):
        if isinstance(found, functools.partial) and not all(map(_is_fixed, (*found.args, *found.keywords.values()))):
            return "has a parameter that is more than numbers and texts"
        found = found.func if isinstance(found, functools.partial) else found.policy
    if not isinstance(found, Guarded) or found.source is None:
        is_sorties = str(getattr(found, "__module__", "")).startswith("sortie.policies.")
        return "" if is_sorties and not isinstance(found, Guarded) else NO_FILE
    try:
        own = _meaning(_File(found.source.file), found.source.name, None)
        if not isinstance(own, _Own):
            return f"is no plain function ({found.source.name})"
        waiting, done = [own], list[_Own]()
        while waiting:
            one = waiting.pop()
            if one not in done:
                done.append(one)
                waiting += _Walk(one).reached
    except (NotAllowed, SyntaxError, RecursionError, OSError) as error:
        return str(error)
    return ""


def _is_fixed(value: object) -> bool:
    """Whether a value can never change."""
    if isinstance(value, tuple):
        return all(map(_is_fixed, value))
    return value is None or isinstance(value, Enum) or type(value) in (bool, int, float, str, bytes)


# --- the meanings of names -----------------------------------------------------------------------


class _Import(NamedTuple):
    module: str
    item: str
    """Empty for the module itself."""
    level: int


class _File:
    """A source file, and what gives its names a meaning at module level; None is a meaning that no proof follows."""

    def __init__(self, path: Path) -> None:
        self.path, tree = path, ast.parse(path.read_bytes())
        self.meanings: dict[str, list[Any]] = {}
        self.postpones_annotations = False
        for node in _outside_functions(tree):
            for name, meaning in _given(node):
                self.meanings.setdefault(name, []).append(meaning)
            if isinstance(node, ast.ImportFrom) and node.module == "__future__":
                self.postpones_annotations |= any(alias.name == "annotations" for alias in node.names)
        for node in ast.walk(tree):
            for name in node.names if isinstance(node, ast.Global) else ():
                self.meanings.setdefault(name, []).append(None)


def _outside_functions(node: ast.AST) -> Iterator[ast.AST]:
    for below in ast.iter_child_nodes(node):
        yield below
        if not isinstance(below, (ast.FunctionDef, ast.Lambda, ast.ClassDef, *_COMPREHENSIONS)):
            yield from _outside_functions(below)


def _given(node: ast.AST) -> Iterator[tuple[str, Any]]:
    """The names that a statement gives a meaning."""
    match node:
        case ast.FunctionDef(name=name):
            yield name, node
        case ast.Import(names=aliases):
            for alias in aliases:
                yield alias.asname or alias.name.partition(".")[0], _Import(alias.name, "", 0)
        case ast.ImportFrom(module=module, names=aliases, level=level):
            for alias in aliases:
                yield alias.asname or alias.name, _Import(module or "", alias.name, level)
        case (
            ast.Assign(targets=[ast.Name(id=name)], value=value) | ast.AnnAssign(target=ast.Name(id=name), value=value)
        ):
            yield name, value
        case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values)) if len(targets) == len(values):
            for target, value in zip(targets, values, strict=True):
                yield from ((name, value if isinstance(target, ast.Name) else None) for name in _names_in(target))
        case ast.stmt() | ast.NamedExpr() | ast.withitem() | ast.MatchAs() | ast.MatchStar() | ast.ExceptHandler():
            yield from ((name, None) for name in (getattr(node, "name", None),) if name)
            for part in ast.iter_child_nodes(node) if not isinstance(node, ast.ClassDef) else ():
                yield from ((name, None) for name in _names_in(part) if not isinstance(part, ast.stmt))


def _names_in(target: ast.AST) -> list[str]:
    return [node.id for node in ast.walk(target) if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load)]


@dataclass(frozen=True, eq=False)
class _Own:
    """A function of the policy's."""

    file: _File
    function: ast.FunctionDef

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Own) and (self.file.path, self.function.name) == (
            other.file.path,
            other.function.name,
        )


class _Constant(NamedTuple):
    """What stands at module level under a name."""

    is_table: bool


def _meaning(file: _File, name: str, node: ast.AST | None) -> Any:
    """An `_Own`, a `_Constant`, or an object of Python's or Sortie's."""
    meanings = file.meanings.get(name)
    if meanings is None and name in _BUILTINS:
        return getattr(builtins, name)
    if meanings is None or len(meanings) > 1 or meanings[0] is None:
        raise NotAllowed(f"uses {name}", node)
    meaning = meanings[0]
    if isinstance(meaning, ast.FunctionDef):
        return _Own(file, meaning)
    if not isinstance(meaning, _Import):
        return _constant(file, meaning, name)
    module, item, level = meaning
    if module == "math" or module.partition(".")[0] == "sortie":
        found = importlib.import_module(module if item else module.partition(".")[0] if name == "sortie" else module)
        return _listed(getattr(found, item, None), item, node) if item else found
    path = file.path.parents[max(level, 1) - 1].joinpath(*module.split(".")).with_suffix(".py")
    if not item or not module or not path.is_file():
        raise NotAllowed(f"uses {name}", node)
    return _meaning(_File(path), item, node)


def _listed(found: Any, name: str, node: ast.AST | None) -> Any:
    """An object of a module's, if a policy may use it."""
    of_math = getattr(found, "__module__", "") == "math" and name != "sumprod"
    if id(found) not in _SORTIES and not _is_fixed(found) and not inspect.ismodule(found) and not of_math:
        raise NotAllowed(f"uses {name}", node)
    return found


def _object(file: _File, node: ast.AST) -> Any:
    """What a dotted name at module level means."""
    match node:
        case ast.Name(id=name):
            return _meaning(file, name, node)
        case ast.Attribute(value=base, attr=attr):
            owner = _object(file, base)
            if inspect.ismodule(owner) or any(owner is kind for kind in _ENUMS):
                return _listed(getattr(owner, attr, None), attr, node)
    raise NotAllowed(f"uses {ast.unparse(node)}", node)


def _constant(file: _File, node: ast.expr, name: str) -> _Constant:
    """Check that an expression at module level is a constant, or a table of constants."""
    match node:
        case ast.List(elts=parts):
            pass
        case ast.Dict(keys=keys, values=values) if None not in keys:
            parts = [*filter(None, keys), *values]
        case _:
            parts = [node]
    for part in (below for top in parts for below in ast.walk(top)):
        found = _object(file, part) if isinstance(part, ast.Name | ast.Attribute) else None
        is_known = any(found is known for known in _OF_NUMBERS) or getattr(found, "__module__", "") == "math"
        is_fixed = _is_fixed(found) or found == _Constant(False) or is_known or inspect.ismodule(found)
        if not isinstance(part, _CONSTANTS) or not is_fixed or (isinstance(part, ast.Call) and part.keywords):
            raise NotAllowed(f"sets {name} to more than a constant", part)
    return _Constant(parts != [node])


# --- the walk ------------------------------------------------------------------------------------


class _Walk:
    """Walks one function at module level, with those in it.

    Raises:
        NotAllowed: it has something that is not listed.
    """

    def __init__(self, own: _Own) -> None:
        self._file, function = own.file, own.function
        self.reached: list[_Own] = []
        self._scopes: list[set[str]] = []
        for decorator in function.decorator_list:
            called = _object(self._file, decorator.func if isinstance(decorator, ast.Call) else decorator)
            if not any(called is known for known in _DECORATORS):
                raise NotAllowed(f"has the decorator {ast.unparse(decorator)}", decorator)
        for default in (*function.args.defaults, *filter(None, function.args.kw_defaults)):
            if _constant(self._file, default, "a default value").is_table:
                raise NotAllowed("has a default value that may change", default)
        self._function(function)

    def _function(self, node: ast.FunctionDef | ast.Lambda) -> None:
        parts = node.body if isinstance(node, ast.FunctionDef) else [node.body]
        arguments = {part.arg for part in ast.walk(node.args) if isinstance(part, ast.arg)}
        self._scopes.append(arguments | {name for part in parts for name in _bound(part)})
        for part in parts:
            self._visit(part, getattr(node, "name", "") in _REASONS)
        self._scopes.pop()

    def _visit(self, node: ast.AST | None, may_be_text: bool = False) -> None:
        """Check a part. A text with numbers may only be where it becomes a reason."""
        if node is None:
            return
        if not isinstance(node, (*_STATEMENTS, *_EXPRESSIONS, ast.FunctionDef)):
            raise NotAllowed(f"has {_WORDS.get(type(node), type(node).__name__)}", node)
        visit = getattr(self, f"_{type(node).__name__.lower()}", None)
        if visit is not None:
            visit(node, may_be_text)
            return
        texts = {id(part) for part in _texts_in(node)} if may_be_text else set()
        for part in ast.iter_child_nodes(node):
            self._visit(part, id(part) in texts)

    # --- statements

    def _functiondef(self, node: ast.FunctionDef, _: bool) -> None:
        annotations = [node.returns, *(part.annotation for part in ast.walk(node.args) if isinstance(part, ast.arg))]
        if node.decorator_list or (any(annotations) and not self._file.postpones_annotations):
            raise NotAllowed("has a decorator, or an annotation that is evaluated, on a function in a function", node)
        self._lambda(node, False)

    def _assign(self, node: ast.Assign, _: bool) -> None:
        for target in node.targets:
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                for one, value in zip(target.elts, node.value.elts, strict=False):
                    self._sets(one, value)
            else:
                self._sets(target, node.value)

    def _annassign(self, node: ast.AnnAssign | ast.AugAssign | ast.NamedExpr, _: bool) -> None:
        self._sets(node.target, node.value)

    _augassign = _annassign

    def _namedexpr(self, node: ast.NamedExpr, may_be_text: bool) -> None:
        self._sets(node.target, node.value)
        self._name(ast.copy_location(ast.Name(node.target.id), node), may_be_text)

    def _sets(self, target: ast.expr, value: ast.expr | None) -> None:
        """A value goes to a local name, or into what a local name means."""
        root = target
        while isinstance(root, ast.Subscript):
            self._visit(root.slice)
            root = root.value
        names = [root] if isinstance(root, ast.Name) else getattr(target, "elts", [None])
        for name in (one.value if isinstance(one, ast.Starred) else one for one in names):
            if (
                not isinstance(name, ast.Name)
                or not self._is_local(name.id)
                or (root is target and len(names) != 1 and name.id in _REASONS)
            ):
                raise NotAllowed(f"sets {ast.unparse(target)}", target)
        self._visit(value, isinstance(target, ast.Name) and target.id in _REASONS)

    def _delete(self, node: ast.Delete, _: bool) -> None:
        for target in node.targets:
            self._sets(target, None)

    def _return(self, node: ast.Return, may_be_text: bool) -> None:
        self._visit(node.value, may_be_text)

    def _raise(self, node: ast.Raise, _: bool) -> None:
        if node.cause is not None or not isinstance(node.exc, ast.Call) or node.exc.keywords:
            raise NotAllowed("raises more than an error with a text", node)
        self._visit(node.exc.func)
        for part in node.exc.args:
            self._visit(part, True)

    def _assert(self, node: ast.Assert, _: bool) -> None:
        if any(isinstance(part, ast.NamedExpr) for part in ast.walk(node.test)):
            raise NotAllowed("sets a name in an assert", node)
        self._visit(node.test)
        self._visit(node.msg, True)

    # --- expressions

    def _lambda(self, node: ast.Lambda | ast.FunctionDef, _: bool) -> None:
        for default in (*node.args.defaults, *node.args.kw_defaults):
            self._visit(default)
        self._function(node)

    def _listcomp(self, node: Any, may_be_text: bool) -> None:
        self._scopes.append({name for generator in node.generators for name in _names_in(generator.target)})
        for generator in node.generators:
            self._sets(generator.target, None)
            self._looked_up(generator.iter)
            for part in generator.ifs:
                self._visit(part)
        self._visit(getattr(node, "key", None))
        self._visit(node.value if isinstance(node, ast.DictComp) else node.elt, may_be_text)
        self._scopes.pop()

    _dictcomp = _generatorexp = _listcomp

    def _for(self, node: ast.For, may_be_text: bool) -> None:
        self._sets(node.target, None)
        self._looked_up(node.iter)
        for part in (*node.body, *node.orelse):
            self._visit(part, may_be_text)

    def _joinedstr(self, node: ast.JoinedStr, may_be_text: bool) -> None:
        for part in node.values:
            if isinstance(part, ast.FormattedValue):
                computes = part.format_spec is not None and not isinstance(part.format_spec.values[0], ast.Constant)  # type: ignore[attr-defined]
                if not may_be_text or part.conversion != -1 or computes:
                    raise NotAllowed("uses an f-string with values for more than `reason` or `why`", node)
                self._visit(part.value, True)

    def _compare(self, node: ast.Compare, _: bool) -> None:
        for op, side in zip(node.ops, node.comparators, strict=True):
            if isinstance(op, ast.Is | ast.IsNot) and not self._is_single(side):
                raise NotAllowed("compares by `is` with more than None, a truth value or an enum", node)
            self._looked_up(side)
        self._visit(node.left)

    def _is_single(self, node: ast.expr) -> bool:
        """Whether there is only one object of this value."""
        if isinstance(node, ast.Constant):
            return node.value is None or isinstance(node.value, bool)
        return (
            isinstance(node, ast.Attribute) and self._is_outside(node) and isinstance(_object(self._file, node), Enum)
        )

    def _binop(self, node: ast.BinOp, may_be_text: bool) -> None:
        is_text = isinstance(node.left, ast.JoinedStr) or isinstance(getattr(node.left, "value", None), str)
        if isinstance(node.op, ast.MatMult) or (isinstance(node.op, ast.Mod) and is_text):
            raise NotAllowed("has % on a text, or the operator @", node)
        for part in (node.left, node.right):
            self._visit(part, may_be_text and isinstance(node.op, ast.Add))

    def _is_local(self, name: str) -> bool:
        return any(name in scope for scope in self._scopes)

    def _is_outside(self, node: ast.AST) -> bool:
        """Whether a dotted name is one of a module or an enum."""
        while isinstance(node, ast.Attribute):
            node = node.value
        return (
            isinstance(node, ast.Name)
            and not self._is_local(node.id)
            and not isinstance(_meaning(self._file, node.id, node), _Constant)
        )

    def _name(self, node: ast.Name, may_be_text: bool = False, looked_up: bool = False) -> None:
        if node.id in _REASONS and not may_be_text:
            raise NotAllowed(f"uses {node.id} for more than a reason", node)
        if not self._is_local(node.id):
            found = _meaning(self._file, node.id, node)
            if isinstance(found, _Own):
                self.reached.append(found)
            elif found is str or found is sum or (found == _Constant(True) and not looked_up):
                raise NotAllowed(f"hands on {node.id}", node)

    def _looked_up(self, node: ast.expr) -> None:
        """A part of which nothing but its items is used: it may be a table."""
        if isinstance(node, ast.Name):
            self._name(node, False, looked_up=True)
        else:
            self._visit(node)

    def _subscript(self, node: ast.Subscript, may_be_text: bool) -> None:
        self._looked_up(node.value)
        self._visit(node.slice)

    def _attribute(self, node: ast.Attribute, may_be_text: bool) -> None:
        if self._is_outside(node):
            _object(self._file, node)
            return
        if node.attr not in _ATTRIBUTES or (node.attr == "reason" and not may_be_text):
            raise NotAllowed(f"uses .{node.attr}", node)
        self._looked_up(node.value) if node.attr in ("get", "items", "values") else self._visit(node.value)

    def _call(self, node: ast.Call, may_be_text: bool) -> None:
        found: Any = None
        if isinstance(node.func, ast.Name) and not self._is_local(node.func.id):
            found = _meaning(self._file, node.func.id, node)
        elif isinstance(node.func, ast.Attribute) and self._is_outside(node.func):
            found = _object(self._file, node.func)
        parameters = list[str]()
        if isinstance(found, _Own):
            parameters = [part.arg for part in (*found.function.args.posonlyargs, *found.function.args.args)]
        elif id(found) in _SORTIES:
            parameters = list(inspect.signature(found).parameters)
        if found is sum and not isinstance(node.args[0], ast.GeneratorExp | ast.ListComp):  # may round otherwise
            raise NotAllowed("adds with sum(…) in place of sortie.scenarios.plain_sum.plain_sum", node)
        if found is str and not may_be_text:
            raise NotAllowed("uses str(…) for more than a reason", node)
        if found is not sum and found is not str:
            self._visit(node.func, may_be_text)
        joins = isinstance(node.func, ast.Attribute) and node.func.attr == "join"
        for place, part in enumerate(node.args):
            named = parameters[place] if place < len(parameters) else ""
            self._visit(part, named in _REASONS or (may_be_text and (joins or found is str)))
        for keyword in node.keywords:
            self._visit(keyword.value, keyword.arg in _REASONS)


def _texts_in(node: ast.AST) -> Iterable[ast.AST]:
    """The parts of which an expression or a statement is made, where these may be texts."""
    match node:
        case ast.BoolOp(values=[*_, last]):
            return (last,)
        case ast.IfExp(body=body, orelse=other):
            return (body, other)
        case ast.If(body=parts, orelse=others) | ast.While(body=parts, orelse=others):
            return (*parts, *others)
        case ast.Match(cases=cases):
            return cases
        case ast.match_case(body=parts):
            return parts
        case ast.List(elts=parts) | ast.Tuple(elts=parts):
            return parts
    return ()


def _bound(node: ast.AST, within: bool = False) -> Iterator[str]:
    """The names that a part of a function binds in it; `within` a comprehension only `:=` does."""
    match node:
        case ast.Name(id=name, ctx=ast.Store() | ast.Del()) if not within:
            yield name
        case ast.NamedExpr(target=ast.Name(id=name)) | ast.FunctionDef(name=name) | ast.MatchAs(name=str(name)):
            yield name
    if not isinstance(node, ast.FunctionDef | ast.Lambda):
        for part in ast.iter_child_nodes(node):
            yield from _bound(part, within or isinstance(node, _COMPREHENSIONS))
