"""Compiles a policy's source with a check at each place where plain Python would answer for a stand-in without asking it."""

from __future__ import annotations

import ast
import types
from typing import Any


def compiled(source: bytes, path: str) -> types.CodeType:
    tree = Checks().visit(ast.parse(source, path))
    code: types.CodeType = compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True)
    return code


class Checks(ast.NodeTransformer):
    """Puts the checks into a source."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name) and node.func.id == "super":
            return node
        return ast.copy_location(ast.Call(_name("__called__"), [node.func, *node.args], node.keywords), node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        self.generic_visit(node)
        if not any(isinstance(op, ast.Is | ast.IsNot) for op in node.ops):
            return node
        if len(node.ops) > 1:
            raise SyntaxError("has `is` in a chain of comparisons")
        same: ast.expr = ast.Call(_name("__same__"), [node.left, node.comparators[0]], [])
        return ast.copy_location(ast.UnaryOp(ast.Not(), same) if isinstance(node.ops[0], ast.IsNot) else same, node)

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
        if not isinstance(node.op, ast.Mod):
            return node
        return ast.copy_location(ast.Call(_name("__percent__"), [node.left, node.right], []), node)

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.op, ast.Mod):
            raise SyntaxError("has `%=`")
        return node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        self.generic_visit(node)
        if not isinstance(node.ctx, ast.Load):
            node.value = ast.Call(_name("__own__"), [node.value, ast.Constant(node.attr)], [])
            return node
        return ast.copy_location(ast.Call(_name("__attribute__"), [node.value, ast.Constant(node.attr)], []), node)

    def _decorated(self, node: Any) -> Any:
        returns, node.returns = getattr(node, "returns", None), None
        self.generic_visit(node)
        node.returns = returns
        node.decorator_list = [ast.Call(_name("__decorator__"), [d], []) for d in node.decorator_list]
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> Any:
        return self._decorated(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> Any:
        return self._decorated(node)

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

    def visit_MatchValue(self, node: ast.MatchValue) -> ast.AST:
        return node  # a pattern has names alone

    def visit_MatchClass(self, node: ast.MatchClass) -> ast.AST:
        for pattern in (*node.patterns, *node.kwd_patterns):
            self.visit(pattern)
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.target = self.visit(node.target)
        node.value = None if node.value is None else self.visit(node.value)
        return node

    def visit_arg(self, node: ast.arg) -> ast.AST:
        return node

    def visit_Global(self, node: ast.Global) -> ast.AST:
        raise SyntaxError(f"changes the global {node.names[0]}")

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> ast.AST:
        raise SyntaxError("has asynchronous code")


def _name(text: str) -> ast.Name:
    return ast.Name(text, ast.Load())
