"""Compiles a policy's source with a check at each place where plain Python would answer for a stand-in without asking it."""

from __future__ import annotations

import ast
import types
from typing import Any

from sortie.policies.verification.notes import NOTED, Notes
from sortie.policies.verification.plain import refuse_other_python


def compiled(source: bytes, path: str) -> types.CodeType:
    """The code of a policy's source, with the checks and with notes.

    Raises:
        SyntaxError: it is not plain Python (`plain`).
    """
    tree = ast.parse(source, path)
    refuse_other_python(tree)
    checked = ast.fix_missing_locations(Checks().visit(Notes().visit(tree)))
    code: types.CodeType = compile(checked, path, "exec", dont_inherit=True)
    return code


_SET_OPERATORS = (ast.BitAnd, ast.BitOr, ast.BitXor, ast.Sub)


class Checks(ast.NodeTransformer):
    """Puts the checks into a source."""

    def __init__(self) -> None:
        self._matches = 0

    def visit_Call(self, node: ast.Call) -> Any:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name) and node.func.id in ("super", NOTED):
            return node
        return _placed(_call("__called__", node.func, *node.args, keywords=node.keywords), node)

    def visit_Compare(self, node: ast.Compare) -> Any:
        self.generic_visit(node)
        if not any(isinstance(op, ast.Is | ast.IsNot | ast.In | ast.NotIn) for op in node.ops):
            return node
        if len(node.ops) > 1:
            raise SyntaxError(f"has `is` or `in` in a chain of comparisons in line {node.lineno}")
        check = "__same__" if isinstance(node.ops[0], ast.Is | ast.IsNot) else "__among__"
        same = _call(check, node.left, node.comparators[0])
        negative = isinstance(node.ops[0], ast.IsNot | ast.NotIn)
        return _placed(ast.UnaryOp(ast.Not(), same) if negative else same, node)

    def visit_Set(self, node: ast.Set) -> Any:
        return self._set(node)

    def visit_SetComp(self, node: ast.SetComp) -> Any:
        return self._set(node)

    def _set(self, node: ast.expr) -> Any:
        self.generic_visit(node)
        return _placed(_call("__unordered__", node), node)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> Any:
        self.generic_visit(node)
        return _placed(_call("__text__", *map(_part, node.values)), node)

    def visit_BinOp(self, node: ast.BinOp) -> Any:
        self.generic_visit(node)
        if isinstance(node.op, _SET_OPERATORS):
            node.left, node.right = _call("__plain_set__", node.left), _call("__plain_set__", node.right)
            return _placed(_call("__unordered__", node), node)
        if isinstance(node.op, ast.Mod):
            node.left = _call("__no_text__", node.left)
        return node

    def visit_AugAssign(self, node: ast.AugAssign) -> Any:
        self.generic_visit(node)
        if isinstance(node.op, ast.Mod):
            raise SyntaxError("has `%=`")
        if not isinstance(node.op, _SET_OPERATORS):
            return node
        if not isinstance(node.target, ast.Name):
            node.value = _call("__no_set__", node.value)
            return node
        # The keys of a mapping give a new, plain set.
        node.value = _call("__operand__", _name(node.target.id), node.value)
        held = ast.Assign([ast.Name(node.target.id, ast.Store())], _call("__unordered__", _name(node.target.id)))
        return [node, _placed(held, node)]

    def visit_Attribute(self, node: ast.Attribute) -> Any:
        self.generic_visit(node)
        if not isinstance(node.ctx, ast.Load):
            node.value = _call("__own__", node.value, ast.Constant(node.attr))
            return node
        return _placed(_call("__attribute__", node.value, ast.Constant(node.attr)), node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> Any:
        returns, node.returns = node.returns, None
        self.generic_visit(node)
        node.returns = returns
        node.decorator_list = _decorators(node)
        return node

    def visit_ClassDef(self, node: ast.ClassDef) -> Any:
        self.generic_visit(node)
        node.decorator_list = [*_decorators(node), _name("__made__")]
        return node

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> ast.AST:
        node.body = [x for part in node.body for x in _listed(self.visit(part))]
        return node  # its kinds are names of Python's own errors

    def visit_Assign(self, node: ast.Assign) -> Any:
        self.generic_visit(node)
        if any(map(_unpacks, node.targets)):
            if len(node.targets) > 1:
                raise SyntaxError("unpacks a value that it also keeps")
            node.value = _call("__each__", node.value)
        return node

    def visit_Starred(self, node: ast.Starred) -> Any:
        self.generic_visit(node)
        if isinstance(node.ctx, ast.Load):
            node.value = _call("__each__", node.value)
        return node

    def visit_For(self, node: ast.For) -> Any:
        self.generic_visit(node)
        node.iter = _call("__each__", node.iter)
        return node

    def visit_comprehension(self, node: ast.comprehension) -> Any:
        self.generic_visit(node)
        node.iter = _call("__each__", node.iter)
        return node

    def visit_YieldFrom(self, node: ast.YieldFrom) -> Any:
        self.generic_visit(node)
        node.value = _call("__each__", node.value)
        return node

    def visit_Match(self, node: ast.Match) -> Any:
        """A match as the comparisons that Python makes of it, so that each of its names is checked as elsewhere."""
        self._matches += 1
        subject = f"__matched_{self._matches}__"
        rest: list[ast.stmt] = []
        for case in reversed(node.cases):
            test = _matches(case.pattern, subject)
            if case.guard is not None:
                test = ast.BoolOp(ast.And(), [test, case.guard])
            rest = [ast.If(test, case.body, rest)]
        held = ast.Assign([ast.Name(subject, ast.Store())], node.subject)
        return [x for part in (held, *rest) for x in _listed(self.visit(_placed(part, node)))]

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.target = self.visit(node.target)
        node.value = None if node.value is None else self.visit(node.value)
        return node

    def visit_arg(self, node: ast.arg) -> Any:
        return node  # with its annotation, which is made of types alone


def _decorators(node: ast.FunctionDef | ast.ClassDef) -> list[ast.expr]:
    """The decorators, each with whether it gets what stands below it, and not what another decorator made of that."""
    return [_call("__decorator__", d, ast.Constant(d is node.decorator_list[-1])) for d in node.decorator_list]


def _unpacks(target: ast.expr) -> bool:
    of_slice = isinstance(target, ast.Subscript) and isinstance(target.slice, ast.Slice)
    return of_slice or isinstance(target, ast.Tuple | ast.List)


def _matches(pattern: ast.pattern, subject: str) -> ast.expr:
    """The comparison that a pattern stands for."""
    match pattern:
        case ast.MatchValue(value=value):
            return ast.Compare(_name(subject), [ast.Eq()], [value])
        case ast.MatchSingleton(value=value):
            return ast.Compare(_name(subject), [ast.Is()], [ast.Constant(value)])
        case ast.MatchOr(patterns=patterns):
            return ast.BoolOp(ast.Or(), [_matches(one, subject) for one in patterns])
        case ast.MatchAs(pattern=None, name=None):
            return ast.Constant(True)
        case ast.MatchAs(pattern=inner, name=str(name)):
            bound = ast.Tuple([ast.NamedExpr(ast.Name(name, ast.Store()), _name(subject))], ast.Load())  # always true
            return bound if inner is None else ast.BoolOp(ast.And(), [_matches(inner, subject), bound])
    raise SyntaxError(f"has {type(pattern).__name__} in a pattern, which is not plain Python")


def _part(value: ast.expr) -> ast.expr:
    if not isinstance(value, ast.FormattedValue):
        return value
    spec = value.format_spec or ast.Constant("")
    return _call("__written__", value.value, ast.Constant(value.conversion), spec)


def _listed(found: Any) -> list[Any]:
    return found if isinstance(found, list) else [found]


def _name(text: str) -> ast.Name:
    return ast.Name(text, ast.Load())


def _call(check: str, *args: ast.expr, keywords: list[ast.keyword] | None = None) -> ast.Call:
    return ast.Call(_name(check), list(args), keywords or [])


def _placed(made: Any, node: ast.AST) -> Any:
    return ast.copy_location(made, node)
