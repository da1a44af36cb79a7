"""`name(key=value, …)`: how a model or a policy and its parameters are written in one text."""

from __future__ import annotations

import re

_PIECE = re.compile(r"""(?<![^=,:(\[{\s])(?:"(?:\\.|[^"\\])*"|'(?:''|[^'])*')|.""", re.DOTALL)
"""A quoted text, where a value may begin; else one letter."""
_CLOSING = {"(": ")", "[": "]", "{": "}"}


def split_at_commas(text: str) -> list[str] | None:
    """The parts between commas, but for commas in brackets and quotes; None where a bracket has no partner.

    Example:
        >>> split_at_commas("a(x=1, y=[2, 3]), b='c, d'")
        ['a(x=1, y=[2, 3])', "b='c, d'"]
    """
    parts, open_brackets = [""], list[str]()
    for piece in _PIECE.findall(text):
        if piece in _CLOSING:
            open_brackets.append(piece)
        elif piece in _CLOSING.values() and (not open_brackets or _CLOSING[open_brackets.pop()] != piece):
            return None
        if piece == "," and not open_brackets:
            parts.append("")
        else:
            parts[-1] += piece
    return None if open_brackets else [part.strip() for part in parts if part.strip()]


def read_call(text: str) -> tuple[str, list[str]] | None:
    """`name(key=value, …)` as the name and its parameters as written; None where no bracket ends the text.

    Brackets in a folder's name are the folder's.

    Example:
        >>> read_call("all-4(received_budget=0.1)"), read_call("d (x)/own.py:f(y=2)"), read_call("silence")
        (('all-4', ['received_budget=0.1']), ('d (x)/own.py:f', ['y=2']), None)
    """
    for at, letter in enumerate(text) if text.endswith(")") else ():
        name, parts = text[:at].rstrip(), split_at_commas(text[at + 1 : -1]) if letter == "(" else None
        if name and parts is not None:
            return name, parts
    return None
