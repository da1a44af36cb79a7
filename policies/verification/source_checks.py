"""Compiles a policy's source with a check at each place where plain Python would answer for a stand-in without asking it."""

from __future__ import annotations

import ast
import copy
import types
from typing import Any

from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Roster


def compiled(source: bytes, path: str) -> types.CodeType:
    plain = ast.parse(source, path)
    kinds, nonlocals = set[str](), set[str]()
    for node in ast.walk(plain):
        names = {getattr(node, field, None) for field in ("id", "name", "arg", "asname", "rest")}
        reads_name = isinstance(node, ast.Name) and node.id == "__name__" and isinstance(node.ctx, ast.Load)
        taken = RESERVED & names
        if taken and not reads_name and not isinstance(node, ast.keyword):
            raise SyntaxError(f"uses the name {taken.pop()}")
        if "super" in names and not (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)):
            raise SyntaxError("gives the name super another meaning")  # no check stands at its calls
        if isinstance(node, ast.Nonlocal):
            nonlocals.update(node.names)
        if isinstance(node, ast.MatchClass) and isinstance(node.cls, ast.Name):
            kinds.add(node.cls.id)
    if kinds & nonlocals:  # a call within the `match` could change it after its check
        raise SyntaxError("changes a class that a match uses")
    tree = Checks().visit(plain)
    code: types.CodeType = compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True)
    return code


RESERVED = {
    "__called__", "__same__", "__text__", "__written__", "__percent__", "__own__", "__attribute__", "__decorator__",
    "__each__", "__among__", "__pattern__", "__own_kinds__", "__unordered__", "__caught__", "__shown__", "__made__", "__kinds__", "__subject__", "__raised__", "__passed__", "__doubtful__", "__held__", "__key__", "__part__", "__builtins__", "__build_class__", "__name__", "__module__",
    "__qualname__", "__match_args__", "__del__", "__file__", "__spec__", "__loader__", "__cached__", "__path__", "__package__",
}  # fmt: skip
"""The checks, and names by which a policy would say that it is another one, or find where it lies."""
_IN_ANNOTATIONS = (
    ast.Name, ast.Attribute, ast.Subscript, ast.Constant, ast.Tuple, ast.List, ast.BinOp, ast.operator, ast.Load,
)  # fmt: skip
_OF_SORTIE = {name for kind in (Descriptor, Directive, Disc, FleetView, Roster) for name in kind._fields} | {
    "me",
    "peers",
}
"""Attributes that a pattern may name of any class. Python reads them without a check, and modules have none of these names."""
_SET_OPERATORS = (ast.BitAnd, ast.BitOr, ast.BitXor, ast.Sub)


class Checks(ast.NodeTransformer):
    """Puts the checks into a source."""

    def __init__(self) -> None:
        self._bound: list[set[str]] = []
        """The names that each function around this place binds."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name) and node.func.id == "super":
            return node
        return ast.copy_location(ast.Call(_name("__called__"), [node.func, *node.args], node.keywords), node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        self.generic_visit(node)
        if not any(isinstance(op, ast.Is | ast.IsNot | ast.In | ast.NotIn) for op in node.ops):
            return node
        if len(node.ops) > 1:
            raise SyntaxError("has `is` or `in` in a chain of comparisons")
        check = "__same__" if isinstance(node.ops[0], ast.Is | ast.IsNot) else "__among__"
        same: ast.expr = ast.Call(_name(check), [node.left, node.comparators[0]], [])
        negative = isinstance(node.ops[0], ast.IsNot | ast.NotIn)
        return ast.copy_location(ast.UnaryOp(ast.Not(), same) if negative else same, node)

    def visit_Set(self, node: ast.Set) -> ast.AST:
        return self._set(node)

    def visit_SetComp(self, node: ast.SetComp) -> ast.AST:
        return self._set(node)

    def _set(self, node: ast.expr) -> ast.AST:
        self.generic_visit(node)
        return ast.copy_location(ast.Call(_name("__unordered__"), [node], []), node)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        self.generic_visit(node)
        return ast.copy_location(ast.Call(_name("__text__"), [self._part(v) for v in node.values], []), node)

    def _part(self, value: ast.expr) -> ast.expr:
        if not isinstance(value, ast.FormattedValue):
            return value
        spec = value.format_spec or ast.Constant("")
        return ast.Call(_name("__written__"), [value.value, ast.Constant(value.conversion), spec], [])

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.op, _SET_OPERATORS):
            return ast.copy_location(ast.Call(_name("__unordered__"), [node], []), node)
        if not isinstance(node.op, ast.Mod):
            return node
        return ast.copy_location(ast.Call(_name("__percent__"), [node.left, node.right], []), node)

    def visit_AugAssign(self, node: ast.AugAssign) -> Any:
        if isinstance(node.op, ast.Mod):
            raise SyntaxError("has `%=`")
        if not isinstance(node.op, _SET_OPERATORS):
            self.generic_visit(node)
            return node
        # The keys of a mapping give a new, plain set. Taken apart as Python itself does.
        target, before = node.target, list[ast.stmt]()
        if isinstance(target, ast.Name):
            held = target.id
            after = ast.Assign([ast.Name(held, ast.Store())], _unordered(_name(held)))
        else:
            if isinstance(target, ast.Subscript) and any(isinstance(n, ast.Slice) for n in ast.walk(target.slice)):
                raise SyntaxError("changes a slice in place")
            held = "__part__"
            before.append(_assign("__held__", self.visit(target.value)))
            target.value = _name("__held__")
            if isinstance(target, ast.Subscript):
                before.append(_assign("__key__", self.visit(target.slice)))
                target.slice = _name("__key__")
            read = copy.deepcopy(target)
            read.ctx = ast.Load()
            before.append(_assign(held, self.visit(read)))
            after = ast.Assign([self.visit(target)], _unordered(_name(held)))
        change = ast.AugAssign(ast.Name(held, ast.Store()), node.op, self.visit(node.value))
        return [ast.fix_missing_locations(ast.copy_location(n, node)) for n in (*before, change, after)]

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        self.generic_visit(node)
        if not isinstance(node.ctx, ast.Load):
            node.value = ast.Call(_name("__own__"), [node.value, ast.Constant(node.attr)], [])
            return node
        return ast.copy_location(ast.Call(_name("__attribute__"), [node.value, ast.Constant(node.attr)], []), node)

    def _decorated(self, node: Any) -> Any:
        returns, node.returns = self._plain_annotation(getattr(node, "returns", None)), None
        self.generic_visit(node)
        node.returns = returns
        node.decorator_list = [ast.Call(_name("__decorator__"), [d], []) for d in node.decorator_list]
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> Any:
        self._bound.append(_names_bound_in(node))
        found = self._decorated(node)
        self._bound.pop()
        # Compiled code and Python's library, which may call this function, catch errors as well.
        passes = ast.ExceptHandler(_name("__doubtful__"), None, [_passed(), ast.Raise()])
        documented = ast.get_docstring(found) is not None and len(found.body) > 1
        found.body[documented:] = [ast.Try(found.body[documented:], [passes], [], [])]
        if node.name == "__exit__":
            found.body.insert(0, _shown())
        return found

    def visit_ClassDef(self, node: ast.ClassDef) -> Any:
        found = self._decorated(node)
        found.decorator_list.append(_name("__made__"))
        return found

    # Where the stack or the memory ends depends on the process. These are the places where a policy can go on after it.

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> ast.AST:
        self.generic_visit(node)
        node.body[:0] = [_caught()] if node.name is None else [_caught(), _shown()]
        node.type = node.type and ast.Call(_name("__raised__"), [node.type], [])
        return node

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        self.generic_visit(node)
        node.exc = node.exc and ast.Call(_name("__raised__"), [node.exc], [])
        node.cause = node.cause and ast.Call(_name("__raised__"), [node.cause], [])
        return node

    def visit_Try(self, node: ast.Try) -> ast.AST:
        return self._finally(node)

    def visit_TryStar(self, node: ast.TryStar) -> ast.AST:
        return self._finally(node)

    def _finally(self, node: ast.Try | ast.TryStar) -> ast.AST:
        self.generic_visit(node)
        if node.finalbody:
            node.finalbody.insert(0, _caught())
        return node

    def visit_With(self, node: ast.With) -> ast.AST:
        self.generic_visit(node)
        node.body = [ast.Try(node.body, [], [], [_caught(), _shown()])]
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        self.generic_visit(node)
        if any(isinstance(target, ast.Tuple | ast.List) for target in node.targets):
            node.value = ast.Call(_name("__each__"), [node.value], [])
        return node

    def visit_Starred(self, node: ast.Starred) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.ctx, ast.Load):
            node.value = ast.Call(_name("__each__"), [node.value], [])
        return node

    def visit_For(self, node: ast.For) -> ast.AST:
        self.generic_visit(node)
        node.iter = ast.Call(_name("__each__"), [node.iter], [])
        return node

    def visit_comprehension(self, node: ast.comprehension) -> ast.AST:
        self.generic_visit(node)
        node.iter = ast.Call(_name("__each__"), [node.iter], [])
        return node

    def visit_Match(self, node: ast.Match) -> Any:
        patterns = [part for case in node.cases for part in ast.walk(case.pattern)]
        classes = [p for p in patterns if isinstance(p, ast.MatchClass) and isinstance(p.cls, ast.Name)]
        kinds = {ast.unparse(p.cls) for p in classes}
        if kinds & _bound_within(node):
            raise SyntaxError("binds the name of a class in the match that uses it")
        of_own = {ast.unparse(p.cls) for p in classes if not _OF_SORTIE.issuperset(p.kwd_attrs)}
        dotted = [p.value for p in patterns if isinstance(p, ast.MatchValue) and isinstance(p.value, ast.Attribute)]
        self.generic_visit(node)
        if any(isinstance(part, ast.MatchMapping) for part in patterns):
            node.subject = ast.Call(_name("__subject__"), [node.subject], [])
        checks: list[ast.expr] = []
        for check, names in (("__kinds__", kinds), ("__own_kinds__", of_own)):
            if names:
                checks.append(ast.Call(_name(check), [_name(name) for name in sorted(names)], []))
        for value in dotted:
            root, *path = ast.unparse(value).split(".")
            found = ast.Lambda(ast.arguments([], [], None, [], [], None, []), _name(root))
            checks.append(ast.Call(_name("__pattern__"), [found, *map(ast.Constant, path)], []))
        return [ast.fix_missing_locations(ast.copy_location(n, node)) for n in (*map(ast.Expr, checks), node)]

    def visit_MatchValue(self, node: ast.MatchValue) -> ast.AST:
        return node  # a pattern has names alone

    def visit_MatchClass(self, node: ast.MatchClass) -> ast.AST:
        if any(name[0] == "_" or name == "args" for name in node.kwd_attrs):
            raise SyntaxError("matches an attribute that a search cannot follow")
        if not isinstance(node.cls, ast.Name):
            raise SyntaxError("matches a class by a dotted name")  # which no check reads
        for pattern in (*node.patterns, *node.kwd_patterns):
            self.visit(pattern)
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        self._plain_annotation(node.annotation)
        node.target = self.visit(node.target)
        node.value = None if node.value is None else self.visit(node.value)
        return node

    def visit_arg(self, node: ast.arg) -> ast.AST:
        self._plain_annotation(node.annotation)
        return node

    def _plain_annotation(self, node: ast.expr | None) -> ast.expr | None:
        """An annotation, which stays as it is; it must compute nothing, and ask nothing of what a function knows."""
        parts = [] if node is None else list(ast.walk(node))
        names = {part.id for part in parts if isinstance(part, ast.Name)}
        computes = not all(isinstance(part, _IN_ANNOTATIONS) for part in parts)
        reads = any(isinstance(part, ast.Attribute) and part.attr[0] == "_" for part in parts)
        if computes or reads or (len(parts) > 2 and any(names & bound for bound in self._bound)):
            raise SyntaxError("computes an annotation")
        return node

    def visit_Global(self, node: ast.Global) -> ast.AST:
        raise SyntaxError(f"changes the global {node.names[0]} in line {node.lineno}")

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> ast.AST:
        raise SyntaxError("has asynchronous code")


def _names_bound_in(function: ast.FunctionDef) -> set[str]:
    fields = [getattr(node, field, None) for node in ast.walk(function) for field in ("arg", "asname", "name", "rest")]
    stored = [n.id for n in ast.walk(function) if isinstance(n, ast.Name) and not isinstance(n.ctx, ast.Load)]
    return {name for name in (*fields, *stored) if isinstance(name, str)}


def _bound_within(node: ast.Match) -> set[str]:
    """The names that get another value within a `match`."""
    bound = set[str]()
    for part in ast.walk(node):
        if isinstance(part, ast.NamedExpr):
            bound.add(part.target.id)
    for case in node.cases:
        for part in ast.walk(case.pattern):
            bound |= {name for field in ("name", "rest") if (name := getattr(part, field, None)) is not None}
    return bound


def _name(text: str) -> ast.Name:
    return ast.Name(text, ast.Load())


def _assign(name: str, value: ast.expr) -> ast.Assign:
    return ast.Assign([ast.Name(name, ast.Store())], value)


def _unordered(value: ast.expr) -> ast.Call:
    return ast.Call(_name("__unordered__"), [value], [])


def _passed() -> ast.Expr:
    return ast.Expr(ast.Call(_name("__passed__"), [], []))


def _caught() -> ast.Expr:
    return ast.Expr(ast.Call(_name("__caught__"), [], []))


def _shown() -> ast.Expr:
    return ast.Expr(ast.Call(_name("__shown__"), [], []))
