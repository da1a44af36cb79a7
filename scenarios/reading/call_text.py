"""`name(key=value, …)`: how a model or a policy and its parameters are written in one text."""

from __future__ import annotations

import re
from itertools import pairwise

_PIECE = re.compile(r"""(?<![^=,:(\[{\s])(?:"(?:\\.|[^"\\])*"|'(?:''|[^'])*')|.""", re.DOTALL)
"""A quoted text, where a value may begin; else one letter."""
_CLOSING = {"(": ")", "[": "]", "{": "}"}


def split_at_commas(text: str) -> list[str] | None:
    """The parts between commas, but for commas in brackets and quotes; None where a bracket has no partner.

    Example:
        >>> split_at_commas("a(x=1, y=[2, 3]), b='c, d'")
        ['a(x=1, y=[2, 3])', "b='c, d'"]
    """
    marks = _marks(text)
    if marks is None:
        return None
    parts = (text[begin + 1 : end].strip() for begin, end in pairwise((-1, *marks[0], len(text))))
    return [part for part in parts if part]


def read_call(text: str) -> tuple[str, list[str]] | None:
    """`name(key=value, …)` as the name and its parameters as written; None where no bracket ends the text.

    Brackets in a folder's name are the folder's.

    Example:
        >>> read_call("all-4(received_budget=0.1)"), read_call("d (x)/own.py:f(y=2)"), read_call("silence")
        (('all-4', ['received_budget=0.1']), ('d (x)/own.py:f', ['y=2']), None)
    """
    _, opens = _marks(text) or ([], -1)
    name = text[: max(opens, 0)].rstrip()
    return (name, split_at_commas(text[opens + 1 : -1]) or []) if name and text[opens] == "(" else None


def _marks(text: str) -> tuple[list[int], int] | None:
    """Where commas stand outside of brackets and quotes, and where the bracket opens that ends the text, else −1."""
    commas, unclosed, opens = list[int](), list[int](), -1
    for found in _PIECE.finditer(text):
        piece, at, opens = found[0], found.start(), -1
        if piece in _CLOSING:
            unclosed.append(at)
        elif piece in _CLOSING.values():
            if not unclosed or _CLOSING[text[opens := unclosed.pop()]] != piece:
                return None
        elif piece == "," and not unclosed:
            commas.append(at)
    return None if unclosed else (commas, opens)
