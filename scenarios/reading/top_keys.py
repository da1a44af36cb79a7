"""The keys on top of a YAML file, read without loading the file: cheap, and safe on YAML of any origin."""

from __future__ import annotations

import re
from typing import Any

import yaml

_Parser: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # only its event stream is used
_KEY = r"""["']?(\w+)["']?\s*:"""


def top_keys(text: str) -> set[str]:
    """The keys of the first document's top section; empty where the document is no section.

    A file that is broken YAML still has keys: those before the fault, and words after it that stand where keys would.
    The reader can then report the fault.

    Example:
        >>> sorted(top_keys("name: x\\nfleet: {drones: 2}"))
        ['fleet', 'name']
    """
    keys: set[str] = set()
    depth, nodes, in_braces = 0, 0, False
    try:
        for event in yaml.parse(text, Loader=_Parser):
            if isinstance(event, yaml.NodeEvent):
                if depth == 1:  # a key, its value, the next key, ...
                    if nodes % 2 == 0 and isinstance(event, yaml.ScalarEvent):
                        keys.add(event.value)
                    nodes += 1
                if depth == 0:
                    if not isinstance(event, yaml.MappingStartEvent):
                        break
                    in_braces = bool(event.flow_style)
                depth += isinstance(event, yaml.CollectionStartEvent)
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
                if depth == 0:
                    break
    except yaml.YAMLError:
        if not in_braces:
            keys.update(re.findall(f"^{_KEY}", text, re.MULTILINE))
        elif "name" in keys:
            keys.update(re.findall(rf"[{{,]\s*{_KEY}", text))
    return keys
