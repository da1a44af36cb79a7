"""Processor time of plans by the compiled radio (`make compiled`), measured in its own Python."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1])]

from stored import ROOT
from wifi_plan import Case

from sortie.scenarios.code_digest import sources_digest

PYTHON = ROOT / ".venv-compiled/bin/python"


def compiled_cpu_s(cases: Sequence[Case], seeds: Sequence[int]) -> list[float] | None:
    """The median over the seeds, seconds, of each case; None without a compiled install."""
    if not PYTHON.exists():
        return None
    asked = json.dumps([[asdict(case) for case in cases], list(seeds)])
    done = subprocess.run([PYTHON, __file__], input=asked, capture_output=True, text=True, check=True)
    sources, found = json.loads(done.stdout)
    if sources != sources_digest(("radio",), ()):
        raise RuntimeError("the compiled radio was built of other sources; run `make compiled`")
    return [float(cpu_s) for cpu_s in found]


def main() -> None:
    from wifi_compare import LOADS, means, through_air

    from sortie.sim.identity import compiled_modules

    given, seeds = json.loads(sys.stdin.read())
    through_air(LOADS[0], 1)  # what is loaded at its first use is no part of a run's time
    if not compiled_modules():
        sys.exit(f"{sys.executable} has no compiled radio")
    found = [means([through_air(Case(**case), seed) for seed in seeds])["cpu_s"] for case in given]
    sys.stdout.write(json.dumps([sources_digest(("radio",), ()), found]))


if __name__ == "__main__":
    main()
