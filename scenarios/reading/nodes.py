"""A scenario's text as a tree that remembers where each value was written, and the errors that point there."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from sortie.scenarios.errors import SortieError, one_line

Scalar = str | int | float | bool | None
Path = tuple[str | int, ...]
"""Where a value stands in a scenario: ("events", 0, "at_s"), written events.0.at_s."""
MAX_DEPTH = 20
"""Of sections and lists within each other."""


class ScenarioError(SortieError):
    """What is wrong with a scenario, in one line: `FILE:LINE: field.path: what, the value, the bound`."""

    def __init__(self, line: str, issues: Iterable[object] = ()) -> None:
        """Args:
        line: the message.
        issues: all that is wrong; none says that the message is all.
        """
        super().__init__(line)
        self._all = [*issues]

    @property
    def issues(self) -> tuple[str, ...]:
        """Everything that is wrong, as far as it was found, a line each."""
        return tuple(one_line(issue) for issue in self._all) or (str(self),)


@dataclass(frozen=True, slots=True)
class Node:
    """One value, as written."""

    value: Scalar | Mapping[str, Node] | Sequence[Node]
    source: str
    """The file, or the `--set` that wrote it."""
    line: int
    """In the file, from 1, of the key if there is one; 0 for `--set`."""
    text: str = ""
    """A scalar as it stands in the source; quoted if it is text."""
    problem: str = ""
    """What the reader has against it (a tag, a duplicate key, an infinite number); empty if nothing."""
    doubt: str = ""
    """How to write it clearly, if YAML 1.1 and 1.2 read it differently (yes, 017); it then counts as text."""

    @property
    def where(self) -> str:
        return f"{self.source}:{self.line}" if self.line else self.source

    def shown(self) -> str:
        """The value, short enough for an error line."""
        if isinstance(self.value, Mapping):
            return "a section"
        if isinstance(self.value, Sequence) and not isinstance(self.value, str):
            return f"a list of {len(self.value)}"
        if self.value is None:
            return "nothing"
        return self.text if len(self.text) <= 60 else self.text[:57] + "..."


@dataclass(frozen=True, slots=True)
class Issue:
    """One thing that is wrong, and where."""

    node: Node
    path: Path
    what: str | Callable[[], str]
    """The text, or how to make it: of thousands of issues only the first is told."""

    def __str__(self) -> str:
        what = self.what if isinstance(self.what, str) else self.what()
        path = dotted(self.path)
        return f"{self.node.where}: {path}: {what}" if path else f"{self.node.where}: {what}"


def dotted(path: Path) -> str:
    """events.0.at_s; a very long key is cut."""
    return ".".join(part if len(part) <= 60 else part[:57] + "..." for part in map(str, path))


def plain(node: Node) -> object:
    """The bare value, without its places."""
    if isinstance(node.value, Mapping):
        return {key: plain(child) for key, child in node.value.items()}
    if isinstance(node.value, Sequence) and not isinstance(node.value, str):
        return [plain(child) for child in node.value]
    return node.value


def as_node(value: object, source: str = "vary", line: int = 0, depth: int = 1) -> Node:
    """A plain value as nodes that all say they stand at one place; what is not plain has a problem that says so."""
    if hasattr(value, "item") and getattr(value, "ndim", 0) == 0:
        value = value.item()  # a number of numpy's
    if depth > MAX_DEPTH:
        return Node(None, source, line, problem=f"{depth} levels deep, must be at most {MAX_DEPTH}")
    if isinstance(value, Mapping):
        if odd := [key for key in value if not isinstance(key, str)]:
            return Node(None, source, line, problem=f"the key {odd[0]!r} is no text")
        return Node({key: as_node(v, source, line, depth + 1) for key, v in value.items()}, source, line)
    if isinstance(value, list | tuple):
        return Node([as_node(v, source, line, depth + 1) for v in value], source, line)
    if isinstance(value, float) and not math.isfinite(value):
        return Node(None, source, line, problem=f"{value}, must be a finite number")
    if value is None or isinstance(value, str | int | float):
        return Node(value, source, line, text=f"{value:g}" if isinstance(value, float) else str(value))
    return Node(None, source, line, problem=f"{value!r:.60}, must be a number, text, a list or a section")


def child(node: Node, part: str | int) -> Node | None:
    """The node below `node` at a key or index; None if there is none."""
    if isinstance(node.value, Mapping):
        return node.value.get(str(part))
    if isinstance(node.value, Sequence) and not isinstance(node.value, str):
        return node.value[part] if isinstance(part, int) and part < len(node.value) else None
    return None


def problems(node: Node, path: Path = ()) -> Iterator[Issue]:
    """What the reader found, from the top of the tree down; nothing below a node that has a problem itself."""
    if node.problem:
        yield Issue(node, path, node.problem)
    elif node.doubt:
        yield Issue(node, path, f"{node.shown()}, {node.doubt}, or put it in quotes if it is text")
    elif isinstance(node.value, Mapping):
        for key, below in node.value.items():
            yield from problems(below, (*path, key))
    elif isinstance(node.value, Sequence) and not isinstance(node.value, str):
        for i, below in enumerate(node.value):
            yield from problems(below, (*path, i))


def assign(node: Node | None, parts: Sequence[str], new: Node, path: Path = ()) -> Node:
    """A copy of the tree in which the value at `parts` is `new`; sections on the way are made if missing.

    Raises:
        ScenarioError: if the path leads through a plain value or to a list entry that is not there.
    """
    if not parts:
        return new
    part, rest = parts[0], parts[1:]
    here, at = dotted(path), dotted((*path, part))
    if node is None or node.value is None:
        if part.isdigit():
            raise ScenarioError(f"{new.source}: {at}: no such entry, the scenario does not write {here}; set it whole")
        return Node({part: assign(None, rest, new, (*path, part))}, new.source, new.line)
    if isinstance(node.value, Mapping):
        below = assign(node.value.get(part), rest, new, (*path, part))
        return replace(node, value={**node.value, part: below})
    if isinstance(node.value, Sequence) and not isinstance(node.value, str):
        entries = list(node.value)
        if not (part.isdecimal() and part.isascii() and len(part) < 9 and int(part) < len(entries)):
            have = f"{here} has 0 … {len(entries) - 1}" if entries else f"{here} is empty"
            raise ScenarioError(f"{new.source}: {at}: no such entry, {have}")
        i = int(part)
        entries[i] = assign(entries[i], rest, new, (*path, i))
        return replace(node, value=entries)
    raise ScenarioError(f"{new.source}: {at}: no such field, {here} is the value {node.shown()}")


def one_of(words: Iterable[object]) -> str:
    """ "a, b or c"."""
    *most, last = [str(word) for word in words] or [""]
    return f"{', '.join(most)} or {last}" if most else last


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known name that was probably meant: the same but for its last part (the unit), a part of it, a near spelling."""
    names = list(known)
    for stem in (word, word.rpartition("_")[0]):
        for name in names:
            if stem and name.startswith(f"{stem}_"):
                return name
    for name in names:
        if word in name.split("_"):
            return name
    close = difflib.get_close_matches(word[:80], names, n=1)
    return close[0] if close else None
