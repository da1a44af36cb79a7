"""The lane of events in a playback: each event's bar ends with the event, one that is over at once after two seconds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from sortie.scenarios.schema import Scenario
from sortie.sim.results.sentences import event_in_words

NOTHING = "·"
"""What the lane shows while nothing is going on, and every lane after the sortie's end."""
MOMENT_S = 2.0


class Span(NamedTuple):
    """An event's bar."""

    begin_s: float
    end_s: float
    text: str


def spans_of(rows: Iterable[dict[str, Any]], scenario: Scenario) -> list[Span]:
    """The bars of rows of `events`; one that the scenario lets last ends as it says, or with the sortie."""
    until_s = {
        (event.kind, frame_of(event.at_s, scenario)): event.until_s
        if event.until_s is not None
        else scenario.duration_s
        for event in scenario.events
        if hasattr(event, "until_s")
    }
    return [
        Span(
            row["t_s"],
            until_s.get((row["kind"], frame_of(row["t_s"], scenario)), row["t_s"] + MOMENT_S),
            event_in_words(row),
        )
        for row in rows
    ]


def frame_of(t_s: float, scenario: Scenario) -> int:
    """The frame in which an event of this time comes."""
    return round(t_s / scenario.frame_s)


def lane_changes(spans: Sequence[Span], shown: str, from_s: float, until_s: float) -> list[tuple[float, str]]:
    """What the lane shows from when on, from `from_s` to before `until_s`: of the events going on the last to begin.

    Args:
        spans: every bar so far.
        shown: what the lane shows before `from_s`.
        from_s, until_s: changes in this time are wanted.
    """
    changes = []
    for t_s in sorted({at for span in spans for at in (span.begin_s, span.end_s) if from_s <= at < until_s}):
        running = [span for span in spans if span.begin_s <= t_s < span.end_s]
        now = max(running, key=lambda span: span.begin_s).text if running else NOTHING
        if now != shown:
            changes.append((t_s, now))
            shown = now
    return changes
