"""Cyclone DDS has no wheels for Python 3.14 yet: there `sortie live` does not run, and so its tests do not."""

from __future__ import annotations

import sys
from importlib.util import find_spec

collect_ignore_glob = ["test_*.py"] if sys.version_info >= (3, 14) and find_spec("cyclonedds") is None else []
