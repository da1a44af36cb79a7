"""The plain Python that a search follows. Whatever else a policy's source has is refused before it runs.

A stand-in must behave as the real object wherever Python meets it. Python has many places where it asks an object without a
visible call: operators of own classes, patterns, `with`, caught errors, annotations, special names. So a proof does not
follow all of Python: it follows what is listed here, each part of which has been thought through. A policy that needs more
is tested by drawn views.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator

_PLAIN = (
    ast.Module, ast.FunctionDef, ast.ClassDef, ast.Return, ast.Delete, ast.Assign, ast.AugAssign, ast.AnnAssign, ast.For,
    ast.While, ast.If, ast.Match, ast.match_case, ast.Raise, ast.Try, ast.ExceptHandler, ast.Assert, ast.Import,
    ast.ImportFrom, ast.alias, ast.Nonlocal, ast.Expr, ast.Pass, ast.Break, ast.Continue,
    ast.BoolOp, ast.NamedExpr, ast.BinOp, ast.UnaryOp, ast.Lambda, ast.IfExp, ast.Dict, ast.Set, ast.ListComp, ast.SetComp,
    ast.DictComp, ast.GeneratorExp, ast.Yield, ast.YieldFrom, ast.Compare, ast.Call, ast.FormattedValue, ast.JoinedStr,
    ast.Constant, ast.Attribute, ast.Subscript, ast.Starred, ast.Name, ast.List, ast.Tuple, ast.Slice, ast.comprehension,
    ast.arguments, ast.arg, ast.keyword, ast.expr_context, ast.boolop, ast.operator, ast.unaryop, ast.cmpop,
    ast.MatchValue, ast.MatchSingleton, ast.MatchOr, ast.MatchAs, ast.withitem,
)  # fmt: skip
_WORDS: dict[type[ast.AST], str] = {
    ast.With: "a with statement", ast.TryStar: "except*", ast.MatMult: "the operator @", ast.MatchClass: "a class in a pattern",
    ast.MatchSequence: "a sequence in a pattern", ast.MatchMapping: "a mapping in a pattern", ast.Await: "await",
    ast.AsyncFunctionDef: "asynchronous code", ast.AsyncFor: "asynchronous code", ast.AsyncWith: "asynchronous code",
}  # fmt: skip
CAUGHT = frozenset(
    {"ValueError", "KeyError", "IndexError", "LookupError", "ZeroDivisionError", "StopIteration", "StatisticsError"}
)
"""Errors that a policy may catch: a stand-in raises them where, and only where, the real object does."""
_RAISED = CAUGHT | {"TypeError", "RuntimeError", "AssertionError", "NotImplementedError"}
_METHODS = frozenset({"__init__", "__post_init__", "__call__"})
"""Methods with special names that a class may have."""
_ALONE = frozenset({"property", "staticmethod", "classmethod"})
"""What may only stand over a method, without another decorator."""
_FIXED = _RAISED | _ALONE | {"super", "statistics"}
"""Names to which nothing may give another meaning."""


_MOST_NAMED = 3
"""How many parts of a source an error names."""


def refuse_other_python(tree: ast.Module) -> None:
    """Check that a source is plain Python.

    Raises:
        SyntaxError: it is not; the message has the first places and what is there.
    """
    changed = next((node for node in ast.walk(tree) if isinstance(node, ast.Global)), None)
    if changed is not None:
        raise SyntaxError(f"changes the global {changed.names[0]} in line {changed.lineno}")
    later = (part for part in tree.body if isinstance(part, ast.ImportFrom) and part.module == "__future__")
    if not any(alias.name == "annotations" for part in later for alias in part.names):
        _refuse_computing_annotations(tree)  # with it, Python evaluates none
    allowed = _allowed_at_their_places(tree)
    found = {
        (getattr(node, "lineno", 0), what): None
        for node in ast.walk(tree)
        for what in (*_others(node), *(() if node in allowed else _out_of_place(node)))
    }
    if found:
        said = [f"{what} in line {line}" if line else what for line, what in sorted(found)]
        more = f" and {len(said) - _MOST_NAMED} more" if len(said) > _MOST_NAMED else ""
        raise SyntaxError(f"has {', '.join(said[:_MOST_NAMED])}{more}, which is not plain Python")


def _others(node: ast.AST) -> Iterator[str]:
    """What one node has that is not plain Python, in words."""
    if not isinstance(node, _PLAIN) or isinstance(node, ast.MatMult):
        yield _WORDS.get(type(node), type(node).__name__)
    for name in _names_of(node):
        if name[:2] == "__" and not (name == "__all__" and not _is_read(node)):
            yield f"the name {name}"
        if name in _FIXED and not _is_read(node):
            yield f"another meaning of {name}"
    match node:
        case ast.Attribute(attr=name) if name[:2] == "__" and not (name in _METHODS and _is_super(node.value)):
            yield f"the name {name}"
        case ast.comprehension(is_async=1):
            yield "asynchronous code"
        case ast.FormattedValue(conversion=97):
            yield "a conversion by ascii"
        case ast.Constant(value=complex()):
            yield "a complex number"
        case ast.BinOp(op=ast.Mod(), left=ast.Constant(value=str()) | ast.JoinedStr()):
            yield "`%` on text (f-strings may be used)"
        case ast.Attribute(value=ast.Constant(value=str()), attr="format"):
            yield "`format` on text (f-strings may be used)"
        case ast.Assert(test=test) if any(isinstance(part, ast.NamedExpr) for part in ast.walk(test)):
            yield "a name that an assert gives"
        case ast.Try(finalbody=[_, *_]):
            yield "finally"
        case ast.ExceptHandler(name=str()):
            yield "an error with a name"
        case ast.ExceptHandler(type=None):
            yield "an except without a kind of error"
        case ast.ExceptHandler(type=ast.Tuple(elts=kinds)):
            yield from (f"an except for {ast.unparse(kind)}" for kind in kinds if _error(kind) not in CAUGHT)
        case ast.ExceptHandler(type=ast.expr() as kind) if _error(kind) not in CAUGHT:
            yield f"an except for {ast.unparse(kind)}"
        case ast.Raise(cause=ast.expr()):
            yield "a raise with a cause"
        case ast.Raise(exc=ast.Call(func=error) | (ast.expr() as error)) if _error(error) not in _RAISED:
            yield f"a raise of {ast.unparse(error)}"
        case ast.ClassDef():
            yield from _others_in_class(node)
        case ast.FunctionDef(decorator_list=[_, _, *_] as decorators) if any(map(_is_alone, decorators)):
            yield "a decorator beside one that must be alone"


def _is_read(node: ast.AST) -> bool:
    """Whether a node with a name reads what it means, or imports it from where it has this meaning."""
    if isinstance(node, ast.alias):
        return node.asname is None and node.name in ("StatisticsError", "statistics")
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)


def _is_super(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "super"


def _others_in_class(node: ast.ClassDef) -> Iterator[str]:
    if node.keywords:
        yield "a class with keywords"
    for part in node.body:
        match part:
            case ast.FunctionDef():
                if part.name[:2] == "__" and part.decorator_list:
                    yield f"a decorator of {part.name}"
            case ast.AnnAssign(target=ast.Name()) | ast.Pass() | ast.Expr(value=ast.Constant()):
                pass
            case ast.Assign(targets=targets) if all(isinstance(target, ast.Name) for target in targets):
                pass
            case _:
                yield "statements in a class"


def _names_of(node: ast.AST) -> Iterator[str]:
    """The names that a node binds or reads, but for those that have a place of their own (`_out_of_place`)."""
    match node:
        case ast.Name(id=name) if name != "__name__":
            yield name
        case ast.arg(arg=name) | ast.ClassDef(name=name) | ast.MatchAs(name=str(name)):
            yield name
        case ast.FunctionDef(name=name) if name not in _METHODS:
            yield name
        case ast.alias(name=name, asname=asname):
            yield from (part for part in (*name.split("."), asname) if part is not None and part != "__future__")
        case ast.Nonlocal(names=names):
            yield from names


def _error(node: ast.AST) -> str:
    """The name of an error that is caught or raised; empty for anything else."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=ast.Name(id="statistics"), attr="StatisticsError"):
            return "StatisticsError"
    return ""


def _is_alone(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and node.id in _ALONE


_IN_ANNOTATIONS = (
    ast.Name, ast.Attribute, ast.Subscript, ast.Constant, ast.Tuple, ast.List, ast.BinOp, ast.BitOr, ast.Load,
)  # fmt: skip
_TYPES = frozenset(
    {"bool", "bytes", "dict", "float", "frozenset", "int", "list", "object", "set", "str", "tuple", "type"}
)


def _refuse_computing_annotations(tree: ast.Module) -> None:
    """Annotations are evaluated, and no check sees it: they may be made of types alone, which are there in time."""
    names = (n for n in ast.walk(tree) if isinstance(n, ast.Name) and not isinstance(n.ctx, ast.Load))
    stored = Counter(name.id for name in names)
    known = set(_TYPES - stored.keys())
    for part in tree.body:
        match part:
            case ast.Import(names=aliases) | ast.ImportFrom(names=aliases):
                bound = [(alias.asname or alias.name).partition(".")[0] for alias in aliases]
                known.update(name for name in bound if not stored[name])
            case ast.ClassDef(name=name) if not stored[name]:
                known.add(name)
            case ast.Assign(targets=[ast.Name(id=name)], value=alias) if stored[name] == 1:
                known |= set() if _computes(alias, known) else {name}
    for node in ast.walk(tree):
        for annotation in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            if annotation is not None and (what := _computes(annotation, known)):
                line = annotation.lineno
                raise SyntaxError(f"computes an annotation ({what}) in line {line}, which is not plain Python")


def _computes(annotation: ast.expr, known: set[str]) -> str:
    """The part of an annotation that is more than a type; empty if there is none."""
    for part in ast.walk(annotation):
        is_other = not isinstance(part, _IN_ANNOTATIONS)
        is_unknown = isinstance(part, ast.Name) and part.id not in known
        is_deep = isinstance(part, ast.Attribute) and (part.attr[0] == "_" or not isinstance(part.value, ast.Name))
        if is_other or is_unknown or (is_deep and ast.unparse(part)[:16] != "collections.abc."):
            return ast.unparse(part) if isinstance(part, ast.expr) else type(part).__name__
    return ""


def _allowed_at_their_places(tree: ast.Module) -> set[ast.AST]:
    """What is plain where it is, and not anywhere else (`_out_of_place`)."""
    allowed = set[ast.AST]()
    for node in ast.walk(tree):
        match node:
            case ast.If(test=ast.Compare(left=left, ops=[ast.Eq()], comparators=[ast.Constant(value="__main__")])):
                allowed.add(left)
            case ast.Expr(value=made):
                allowed.add(made)
            case ast.Call(func=ast.Name(id="super") as called, args=[], keywords=[]):
                allowed.add(called)
            case ast.ClassDef(body=body):
                methods = [part for part in body if isinstance(part, ast.FunctionDef)]
                allowed.update(methods, (d for method in methods for d in method.decorator_list))
    return allowed


def _out_of_place(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Name) and (node.id in ("__name__", "super") or node.id in _ALONE):
        yield f"the name {node.id}"
    elif isinstance(node, ast.FunctionDef) and node.name in _METHODS:
        yield f"the name {node.name}"
    elif isinstance(node, ast.Yield | ast.YieldFrom):
        yield "a yield that gives something back"
