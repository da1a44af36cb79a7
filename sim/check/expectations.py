"""Compare an outcome with its scenario's own expectations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.report_text import interval
from sortie.scenarios.schema import DecisionExpectation, Expectation, Scenario
from sortie.sim.results.outcome import OutcomeDict, is_number, possible
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.transitions import changes, describe

TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Verdict:
    """One expectation, the value that came out, and whether the expectation holds."""

    expected: str
    got: str
    holds: bool
    because: str
    metric: str = ""
    """The expectation's metric; empty for decisions and golden outcomes."""
    explanation: str = ""
    """Facts from the record, where the expectation fails."""
    replication: int = 0
    """The replication that shows the result best."""
    whole: str = ""
    """Of a golden outcome that moved, a line for each figure."""


def check(
    scenario: Scenario,
    record: SortieRecord,
    result: OutcomeDict,
    replications: Sequence[OutcomeDict] = (),
    others: Mapping[str, Sequence[OutcomeDict]] | None = None,
) -> list[Verdict]:
    """Every expectation of the scenario, in its order.

    Args:
        record, result: of the sortie.
        replications: outcomes of replications 0, 1, …, as many as the expectations ask for.
        others: the same of the policies that expectations are over.
    """

    def checked(e: Expectation) -> Verdict:
        results = [result] if e.replications is None else replications
        compared = [None] * len(results) if e.over is None else (others or {}).get(e.over, ())
        pairs = list(zip(results, compared, strict=False))
        return _check_one(e, pairs) if e.replications is None else _check_mean(e, pairs)

    return [
        *(checked(e) for e in scenario.expect),
        *(_check_decision(e, record) for e in scenario.expect_decisions),
        *([_check_no_others(scenario.expect_decisions, record)] if scenario.expect_no_other_changes else []),
    ]


def in_words(e: Expectation) -> str:
    """`ap50.mission ≥ 0.6 with 95 % over 20`."""
    bounds = []
    if e.equals is not None:
        bounds.append(f"= {e.equals}")
    if e.at_least is not None:
        bounds.append(f"≥ {e.at_least:g}")
    if e.at_most is not None:
        bounds.append(f"≤ {e.at_most:g}")
    off = f" (± {e.tolerance:g})" if e.tolerance else ""
    sure = "" if e.confidence is None else f" with {100 * e.confidence:g} % over {e.replications}"
    over = "" if e.over is None else f" over {e.over}"
    return f"{e.metric}{over} {' and '.join(bounds)}{off}{sure}"


_Pair: TypeAlias = tuple[OutcomeDict, OutcomeDict | None]
"""An outcome, and that of the same sortie by the policy that the expectation is over, where it is over one."""


def _got(e: Expectation, pair: _Pair) -> Any:
    """The metric, or how much more it is than under the other policy.

    Raises:
        KeyError: no such field, or no difference as one of the two is no number.
    """
    result, other = pair
    own = result.at(e.metric)
    if other is None:
        return own
    theirs = other.at(e.metric)
    if not (is_number(own) and is_number(theirs)):
        raise KeyError(f"{own} and {theirs} under {e.over}, no difference")
    return own - theirs


def _check_one(expectation: Expectation, pairs: Sequence[_Pair]) -> Verdict:
    name, slack = expectation.metric, expectation.tolerance
    expected = in_words(expectation)
    if not pairs:
        return Verdict(expected, f"{expectation.over} not flown", False, expectation.because, name)
    try:
        got = _got(expectation, pairs[0])
    except KeyError as error:
        return Verdict(expected, error.args[0], False, expectation.because, name)
    holds = True
    if expectation.equals is not None:
        truths = [isinstance(x, bool) for x in (got, expectation.equals)]  # Python counts them as numbers
        holds = got == expectation.equals and truths[0] == truths[1]
        if not any(truths) and isinstance(got, int | float) and isinstance(expectation.equals, int | float):
            holds = abs(got - expectation.equals) <= max(TOLERANCE, slack)
    if expectation.at_least is not None or expectation.at_most is not None:
        holds = (
            holds
            and is_number(got)
            and (expectation.at_least is None or got >= expectation.at_least - slack)
            and (expectation.at_most is None or got <= expectation.at_most + slack)
        )
    shown = f"{got:.6g}" if isinstance(got, float) else str(got)
    if pairs[0][1] is not None:
        both = (f"{result.at(name):.6g}" for result in pairs[0] if result is not None)
        shown += f" ({', '.join(both)} under {expectation.over})"
    return Verdict(expected, shown, holds, expectation.because, name)


def _check_mean(e: Expectation, pairs: Sequence[_Pair]) -> Verdict:
    """The mean over replications lies within each bound with the confidence asked for, by one end of an interval alone.

    Where it is over another policy, the differences within pairs of replications are what has a mean. An expectation that
    the replications leave open fails; more replications may settle it.
    """
    assert e.replications is not None and e.confidence is not None  # noqa: S101, PT018
    expected, values = in_words(e), []
    for i, pair in enumerate(pairs[: e.replications]):
        try:
            value = _got(e, pair)
        except KeyError as error:
            return Verdict(expected, f"replication {i}: {error.args[0]}", False, e.because, e.metric, replication=i)
        if not is_number(value):
            return Verdict(expected, f"replication {i}: {value}, no number", False, e.because, e.metric, replication=i)
        values.append(float(value))
    if len(values) < e.replications:
        return Verdict(expected, f"{len(values)} replications flown", False, e.because, e.metric)
    limits = possible(e.metric)
    found = mean_interval(values, limits if e.over is None else limits.of_differences(), 2 * e.confidence - 1)
    low = e.at_least is not None and found.low < e.at_least - e.tolerance
    high = e.at_most is not None and found.high > e.at_most + e.tolerance
    got = f"{interval(found.mean, found.low, found.high, '{:.6g}'.format)} over {len(values)}"
    if not low and not high:
        return Verdict(expected, got, True, e.because, e.metric)
    worst = values.index(min(values) if low else max(values))
    got = f"{got}, {values[worst]:.6g} in replication {worst}"
    return Verdict(expected, got, False, e.because, e.metric, replication=worst)


def _check_decision(e: DecisionExpectation, record: SortieRecord) -> Verdict:
    """Between from_s and until_s some link is given what is expected, or as many links change to it as are expected."""
    whom = ("any drone" if e.drone is None else f"drone {e.drone}") + ("" if e.peer is None else f" → {e.peer}")
    what = " ".join(
        [
            e.representation or "anything",
            *([f"at ≤ {e.rate_at_most_hz:g} Hz"] if e.rate_at_most_hz is not None else []),
            *([f"{'with' if e.roi else 'without'} ROI"] if e.roi is not None else []),
            *([f"because of {e.reason!r}"] if e.reason else []),
        ]
    )
    window = f"in [{e.from_s:g}, {e.until_s:g}] s"
    if e.changes is not None:
        found = [row for row in _changes(record) if _is_expected(e, row)]
        holds = len(found) == e.changes
        got = "; ".join([_counted(len(found), "change"), *map(_row_in_words, found[: 1 if holds else 3])])
        return Verdict(f"{whom}: {_counted(e.changes, 'change')} to {what} {window}", got, holds, e.because)
    rows = [row for row in record.tables["directives"].to_pylist() if _is_of_window(e, row)]
    holding = next((row for row in rows if _is_expected(e, row)), None)
    got = "; ".join(map(_row_in_words, rows[:3] if holding is None else [holding])) or "no decision"
    return Verdict(f"{whom}: {what} decided {window}", got, holding is not None, e.because)


def _check_no_others(expected: Sequence[DecisionExpectation], record: SortieRecord) -> Verdict:
    """Every change of what a link carries is one of those that are expected."""
    others = [row for row in _changes(record) if not any(_is_expected(e, row) for e in expected)]
    got = "; ".join([_counted(len(others), "other"), *map(_row_in_words, others[:3])])
    return Verdict("no changes of what links carry but those of expect_decisions", got, not others, "")


def _changes(record: SortieRecord) -> Iterator[dict[str, Any]]:
    """The directives that change what their link carries."""
    return (row for row, _, _ in changes(record.tables["directives"], {}))


def _is_of_window(e: DecisionExpectation, row: dict[str, Any]) -> bool:
    """Whether a directive is for a link and of a time that the expectation names."""
    return (
        e.from_s - TOLERANCE <= row["t_s"] <= e.until_s + TOLERANCE
        and e.drone in (None, row["drone"])
        and e.peer in (None, row["peer"])
    )


def _is_expected(e: DecisionExpectation, row: dict[str, Any]) -> bool:
    """Whether a directive is all that the expectation names."""
    return (
        _is_of_window(e, row)
        and e.representation in (None, row["representation"])
        and (e.rate_at_most_hz is None or row["rate_hz"] <= e.rate_at_most_hz)
        and (e.roi is None or (row["roi_radius_m"] == row["roi_radius_m"]) == e.roi)  # NaN is no ROI
        and e.reason in row["reason"]
    )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _row_in_words(row: dict[str, Any]) -> str:
    return f"{row['t_s']:.2f} s: {row['drone']} → {row['peer']} {describe(row)} ({row['reason']})"
