"""The public function `rank` and what it returns."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from sortie._api import label
from sortie._run import as_path
from sortie.policies.contract import Policy, PolicyError
from sortie.sim.folders import RunError, write_text
from sortie.sim.user_errors import user_errors

if TYPE_CHECKING:
    import pyarrow as pa

    from sortie.sim.experiment.rank import Ranked
    from sortie.sim.results.summary import Summary


@dataclass(frozen=True, eq=False)
class Ranking:
    """The result of `sortie.rank`: the places of policies on a suite of conditions."""

    ranked: Ranked

    @property
    def places(self) -> dict[str, tuple[int, int]]:
        """The range of places of each policy: the best and the worst one, policies with the highest AP first. With 95 %
        confidence all true places lie within these ranges."""
        return {row.policy: row.place for row in self.ranked.rows}

    @property
    def digest(self) -> str:
        """The first twelve hex digits of SHA-256 over the suite's file, for citations."""
        return self.ranked.digest

    @property
    def faults(self) -> list[str]:
        """A line for each policy asked for that failed in a condition or breaks a rule of the plane."""
        lines = []
        for policy in self.ranked.entries:
            failed, verified = self.ranked.row(policy).failed, self.ranked.verified[policy]
            if failed:
                lines.append(f"{policy} failed in {len(failed)} of {self.ranked.conditions} conditions")
            if not verified.keeps_all:
                lines.append(f"{policy} breaks rules of the plane: {verified.text}")
        return lines

    @cached_property
    def table(self) -> pa.Table:
        """One row for each policy and condition: `policy`, `condition`, `error` (empty if it flew), `fingerprint`, and
        figures of the outcome by their names with dots, such as `ap50.mission`."""
        import pyarrow as pa

        rows = [
            {"policy": p, "condition": c, "error": f.error, "fingerprint": f.fingerprint, **f.values}
            for p, of_policy in self.ranked.flights.items()
            for c, f in of_policy.items()
        ]
        return pa.Table.from_pylist(rows)

    def summary(self) -> Summary:
        """The ranking as `sortie rank` prints it. A notebook and `rich` show it as tables; `str` returns plain text."""
        from sortie.sim.experiment.board import summary

        return summary(self.ranked)

    def save(self, folder: str | Path) -> Path:
        """Write `ranking.json` and the figure `ranking.png` into a folder, and return it.

        Raises:
            RunError: matplotlib is missing (extra `report`), or the files cannot be written.
        """
        from sortie.sim.experiment.board import draw, plain

        place = as_path("folder", folder)
        write_text(place / "ranking.json", json.dumps(plain(self.ranked), indent=1, allow_nan=False) + "\n")
        with user_errors():
            draw(self.ranked, place / "ranking.png")
        return place


def rank(
    policies: str | Policy | Iterable[str | Policy],
    *,
    suite: str | Path = "ranking_v1",
    against: Sequence[str] | None = None,
    again: bool = False,
    by_torch: bool = False,
    further: int | None = None,
    workers: int = 1,
    folder: str | Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Ranking:
    """Rank policies on a fixed, versioned suite of conditions, among all built-in policies.

    Built-in policies are not flown: their results come with Sortie. The thirty flights of a policy take about a minute.

    Args:
        policies: one policy or several. Each is a name, `name(key=value)`, `path/to/file.py:function`, or any callable of
            one FleetView.
        suite: the name of a suite of the library, or a file with a set of conditions whose `seeds` are `[]`.
        against: names of the policies to rank among. None takes every built-in policy with stored results; with `again`,
            every built-in policy.
        again: fly the policies of `against` too, instead of taking their stored results.
        by_torch: fly every policy with the neural detector, which takes minutes for each. The surrogate flies too, as
            control variate: it makes the intervals narrower and adds no bias.
        further: with `by_torch`, the number of further draws of the suite, of thirty conditions each, that only the
            surrogate flies. None takes 3 for a suite of the library and 0 for a file; 0 takes torch alone.
        workers: number of processes that fly policies given by name. Callables fly in this process.
        folder: where flights of policies given by name are kept, so that an interrupted ranking goes on; None keeps them in
            the user's cache folder.
        progress: called with a stage, the number of its steps that are done, and the number of all its steps.

    Raises:
        ScenarioError, PolicyError, RunError: the suite, a policy or the folder is wrong; raised before anything flies. A
            policy that fails in flight raises nothing: it is last in that condition, and `Ranking.faults` says so.

    Example:
        >>> ranking = sortie.rank("boxes")    # doctest: +SKIP
        >>> ranking.places["boxes"]                          # doctest: +SKIP
        (1, 4)
    """
    from sortie.sim.experiment.flight_file import users_file
    from sortie.sim.experiment.rank import Entry
    from sortie.sim.experiment.rank import rank as rank_entries

    asked = [policies] if isinstance(policies, str) or callable(policies) else policies
    if not isinstance(asked, Iterable):
        raise PolicyError(f"policies: {policies!r}, must be a policy or a list of policies: ['worked', my_policy]")
    entries = []
    for policy in asked:
        if not isinstance(policy, str) and not callable(policy):
            raise PolicyError(f"policy: {policy!r}, must be a name, file.py:function or a callable of one FleetView")
        entries.append(Entry(policy) if isinstance(policy, str) else Entry(label(policy), policy))
    if isinstance(against, str):
        raise PolicyError(f"against: {against!r}, must be a list of names: ['worked', 'silence']")
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise RunError(f"workers: {workers!r}, must be a whole number from 1 on")
    if further is not None and (isinstance(further, bool) or not isinstance(further, int) or not 0 <= further <= 100):
        raise RunError(f"further: {further!r}, must be None or a whole number from 0 to 100")
    with user_errors():
        ranked = rank_entries(
            entries,
            users_file() if folder is None else as_path("folder", folder) / "flights.sqlite",
            suite=str(suite),
            against=against,
            again=again,
            by_torch=by_torch,
            further=further,
            workers=workers,
            progress=progress or (lambda stage, done, of: None),
        )
    return Ranking(ranked)
