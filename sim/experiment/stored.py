"""The built-in policies' results on a suite, as they come with Sortie: ranking one's own policy costs only its own flights.

`make figures FIGURE=ranking` flies all built-in policies and writes the file of the newest suite.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from sortie.sim.experiment.flight import Flight
from sortie.sim.experiment.places import METRICS, Flights
from sortie.sim.experiment.verdict import Verified
from sortie.sim.folders import RunError, write_text
from sortie.sim.identity import code_version

FOLDER = Path(__file__).parent / "results"


@dataclass(frozen=True, slots=True)
class Results:
    """Flights of policies on a suite, and what verification says of each policy."""

    suite: str
    digest: str
    """Of the suite's file (`suite.digest_of`)."""
    sortie: str
    """The version of Sortie that flew them."""
    flights: Flights
    verified: Mapping[str, Verified]


def save_results(results: Results, folder: Path = FOLDER) -> Path:
    """Write `SUITE.json`, a flight a line."""
    head = {"suite": results.suite, "digest": results.digest, "sortie": results.sortie, "metrics": METRICS}
    lines = [f" {json.dumps(key)}: {json.dumps(value)}," for key, value in head.items()]
    lines.append(' "policies": {')
    for k, (policy, flights) in enumerate(results.flights.items()):
        lines += [f"  {json.dumps(policy)}: {{", f'   "verified": {json.dumps(asdict(results.verified[policy]))},']
        rows = [
            f"    {json.dumps(c)}: {json.dumps([f.error, f.fingerprint, *f.values.values()])}"
            for c, f in flights.items()
        ]
        lines += ['   "flights": {', ",\n".join(rows), "   }", "  }" + "," * (k < len(results.flights) - 1)]
    path = folder / f"{results.suite}.json"
    write_text(path, "\n".join(["{", *lines, " }", "}"]) + "\n")
    return path


def read_results(suite: str, digest: str, folder: Path = FOLDER) -> Results | None:
    """The stored results on a suite; None where there are none, or only those of another file or of other metrics.

    Raises:
        RunError: the file is damaged.
    """
    path = folder / f"{Path(suite).stem}.json"
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text("utf-8"))
        if found["digest"] != digest or tuple(found["metrics"]) != METRICS:
            return None
        policies = found["policies"]
        flights = {
            policy: {
                condition: Flight(error, fingerprint, dict(zip(METRICS, values, strict=True)))
                for condition, (error, fingerprint, *values) in one["flights"].items()
            }
            for policy, one in policies.items()
        }
        verified = {policy: Verified(**one["verified"]) for policy, one in policies.items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path}: is damaged ({error}); install Sortie again, or use --again") from error
    return Results(found["suite"], digest, found["sortie"], flights, verified)


def made_now(suite: str, digest: str, flights: Flights, verified: Mapping[str, Verified]) -> Results:
    """Results of this version of Sortie."""
    return Results(suite, digest, code_version(), flights, verified)
