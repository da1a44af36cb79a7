"""`Run`: one flown sortie, with its record, outcome and pages."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.nodes import nearest
from sortie.sim.folders import RunError
from sortie.sim.results import run_folder
from sortie.sim.results.accuracy_table import WithAccuracy
from sortie.sim.results.outcome import OutcomeDict, is_zero_count, outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.run_files import RECORDING
from sortie.sim.user_errors import missing, user_errors

if TYPE_CHECKING:
    import networkx as nx
    import pyarrow as pa

    from sortie.scenarios.schema import Scenario
    from sortie.sim.results.summary import Summary


class UnknownMetricError(SortieError, KeyError):
    """A metric that a run does not have."""

    def __str__(self) -> str:
        return str(self.args[0])  # a KeyError's own text is in quotes


class Metrics(dict[str, float]):
    """Metrics by name, as a dict: `metrics["ap50.mission"]`.

    Raises:
        UnknownMetricError: there is no metric of this name; the error suggests a similar one.
    """

    def __missing__(self, name: str) -> float:
        if is_zero_count(name, sum(key.startswith("battery.") for key in self)):
            return 0
        near = nearest(name, self)
        meant = f"did you mean {near}?" if near else "`sorted(run.metrics)` lists the names"
        raise UnknownMetricError(f"{name}: this run has no such metric, {meant}")


@dataclass(frozen=True, eq=False)
class Run:
    """One flown sortie: its record, and what is computed from it.

    `sortie.fly` and `sortie.open_run` return it.

    Example:
        >>> run = sortie.fly("track_target", {"duration_s": 2, "perception.detector": "none"})
        >>> run.policy, run.seed
        ('worked', 1)
        >>> run.tables["descriptors"].num_rows > 0
        True
    """

    record: SortieRecord
    """Everything that happened in the sortie (`sortie.sim.results.record.SortieRecord`)."""
    path: Path | None = None
    """The folder that it was read from; None for a run that was just flown."""

    @property
    def scenario(self) -> Scenario:
        """The scenario as it was flown, with every default filled in."""
        return self.record.scenario

    @property
    def policy(self) -> str:
        """The policy's name in the record."""
        return self.record.policy

    @property
    def seed(self) -> int:
        """The seed of every random draw."""
        return self.record.seed

    @property
    def replication(self) -> int:
        """The number of the repetition; each has other random draws. 0 is the first."""
        return self.record.replication

    @property
    def fingerprint(self) -> str:
        """SHA-256 over every value of the record, hex. Equal runs have equal fingerprints."""
        return self.record.fingerprint

    @property
    def version(self) -> str:
        """The code that made the record: release, plus sign, digest."""
        return self.record.version

    @cached_property
    def tables(self) -> Mapping[str, pa.Table]:
        """The record's tables by name, and `accuracy`, which is computed from them, as `pyarrow.Table`.

        `sim/results/outcome.md` lists every table and column with its unit. `.to_pandas()` and `polars.from_arrow`
        convert a table.
        """
        return WithAccuracy(self.record)

    @cached_property
    def outcome(self) -> OutcomeDict:
        """All figures of the sortie, nested as in `outcome.json`. A ratio with a denominator of 0 is None.

        It is a dictionary, and a field is computed when it is first read. `get` takes a name with dots as well.

        Example:
            >>> run = sortie.fly("track_target", {"duration_s": 2, "perception.detector": "none"})
            >>> run.outcome["bytes"]["data_sent"] == run.outcome.get("bytes.data_sent")
            True
        """
        return outcome(self.record)

    @property
    def metrics(self) -> Metrics:
        """The numbers of the outcome by name, such as `ap50.mission`, as `expect`, `compare` and campaigns use them.

        Numbers without a value are left out, and a count that is left out is 0. An unknown name raises a `SortieError` that is a `KeyError` too.

        Example:
            >>> run = sortie.fly("track_target", {"duration_s": 2, "perception.detector": "none"})
            >>> run.metrics["bytes.data_sent"] == run.outcome["bytes"]["data_sent"]
            True
        """
        return Metrics(self.outcome.flat())

    def graph(self, t_s: float) -> nx.DiGraph:
        """The fleet as a graph at a moment, for `networkx`: drones as nodes, links within earshot as edges.

        Nodes have `position_m`, `soc` (state of charge, 0 … 1), `phase` and `role`; edges `snr_db`, `goodput_mbps` (what
        the link would carry alone on the channel), `loss` (of descriptors), `usable`, `state`, and what was `sent` in the
        last second with its `bytes`.

        Args:
            t_s: the moment, s, from 0 to the sortie's end.

        Raises:
            RunError: the moment is outside the sortie.

        Example:
            >>> run = sortie.fly("track_target", {"duration_s": 2, "perception.detector": "none"})
            >>> fleet = run.graph(1.0)
            >>> len(fleet), fleet.nodes[0]["phase"], fleet.edges[0, 1]["usable"]
            (5, 'search', True)
            >>> import networkx
            >>> usable = networkx.DiGraph((a, b) for a, b, is_usable in fleet.edges(data="usable") if is_usable)
            >>> sorted(networkx.articulation_points(usable.to_undirected(reciprocal=True)))  # it falls apart without them
            []
        """
        from sortie.sim.results.graph import graph

        return graph(self.record, t_s)

    def summary(self) -> Summary:
        """Accuracy, bytes, energy and delays, as the table that `sortie fly` prints.

        A notebook and `rich` show it as a table; `str` returns plain text.

        Example:
            >>> run = sortie.fly("track_target", {"duration_s": 2, "perception.detector": "none"})
            >>> "data plane" in str(run.summary())
            True
        """
        from sortie.sim.results.summary import Summary, outcome_table

        return Summary(outcome_table(self.outcome))

    def decisions(self) -> Summary:
        """When each link changed what it carries, and why, with all events: the second table that `sortie fly` prints.

        Example:
            >>> run = sortie.fly("track_target", {"duration_s": 2, "perception.detector": "none"})
            >>> "decisions and events" in str(run.decisions())
            True
        """
        from sortie.sim.results.summary import Summary, transitions_table

        return Summary(transitions_table(self.outcome))

    def save(self, path: str | Path | None = None, *, recording: bool | None = None, replace: bool = False) -> Path:
        """Write the run's folder: outcome, tables as Parquet, scenario, and the recording for Rerun (`sortie.rrd`).

        Without a path the folder is `runs/SCENARIO-sSEED-POLICY-FINGERPRINT`. `recording` says whether the recording is
        written. None writes it if Rerun is installed (extra `view`).

        The folder is written completely or not at all. If the same run is there already, its folder stays as it is.
        Another run is replaced only if `replace` is True.

        Raises:
            RunError: the folder has another run, or other files; it cannot be written; or `recording` is True and Rerun
                is missing.
        """

        def add_recording(folder: Path) -> None:
            try:
                from sortie.sim.playback.recording import save_rrd
            except ImportError as error:
                if recording:
                    raise missing(error) from error
                return
            save_rrd(self.record, folder / RECORDING)

        place = None if path is None else as_path("path", path)
        return run_folder.save(self.record, place, None if recording is False else add_recording, replace=replace)

    def report(self, path: str | Path) -> Path:
        """Write the run as one HTML page that loads no other files.

        Raises:
            RunError: the page cannot be written, or matplotlib is missing.
        """
        from sortie.sim.results.report import save_page

        place = as_path("path", path)
        save_page(self.record, place)
        return place

    @user_errors()
    def view(self) -> None:
        """Open the run in the Rerun viewer and wait until it is closed.

        Raises:
            RunError: no viewer or no display; or Rerun is missing (extra `view`).
        """
        from sortie.sim.playback.viewer import open_viewer

        with tempfile.TemporaryDirectory() as made:
            open_viewer(self._recording(Path(made)))

    @user_errors()
    def picture(self, path: str | Path, at_s: float = 0.0) -> Path:
        """Save what the viewer shows at simulated time `at_s` as a PNG file. It needs no screen.

        Warns:
            UserWarning: what a view of the viewer could not draw.

        Raises:
            RunError: the viewer cannot draw here, the file cannot be written, or Rerun is missing (extra `view`).
        """
        from sortie.sim.playback.picture import take_picture

        place = as_path("path", path)
        with tempfile.TemporaryDirectory() as made:
            for complaint in take_picture(self._recording(Path(made)), place, at_s):
                warnings.warn(complaint, stacklevel=2)
        return place

    def _recording(self, made: Path) -> Path:
        """The run's own recording where it lies in its folder, else one made in `made`."""
        from sortie.sim.playback.recording import save_rrd

        if self.path is not None and (self.path / RECORDING).is_file():
            return self.path / RECORDING
        save_rrd(self.record, made / RECORDING)
        return made / RECORDING

    def __repr__(self) -> str:
        return f"<Run of {self.scenario.name} under {self.policy}, seed {self.seed}, {self.scenario.duration_s:g} s>"


def as_path(name: str, value: object) -> Path:
    """A path that a user gave for an argument.

    Raises:
        RunError: it is no path.
    """
    if not isinstance(value, str | os.PathLike):
        raise RunError(f"{name}: {value!r}, must be a path")
    return Path(value)
