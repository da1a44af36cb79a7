"""The laboratory's tests: they import `research` from the root of the clone, and helpers of their own."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import suite_settings  # noqa: F401 (it sets what it names)

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "research/tests/helpers")]
# child processes import it as well, from whatever folder they work in
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
