"""A scenario's own expectations, held against its outcome."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from scenarios.schema import DecisionExpectation, Expectation, Scenario
from sim.outcome import describe
from sim.record import SortieRecord

TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Verdict:
    """One expectation, what was got, and whether it holds."""

    expected: str
    got: str
    holds: bool
    because: str


def metric(result: dict[str, Any], dotted: str) -> Any:
    """A field of an outcome by its dotted name; list items by number.

    Raises:
        KeyError: no such field, naming the fields that there are.
    """
    value: Any = result
    for depth, part in enumerate(dotted.split(".")):
        if isinstance(value, list) and part.isdigit() and int(part) < len(value):
            value = value[int(part)]
        elif isinstance(value, dict) and part in value:
            value = value[part]
        else:
            known = (
                ", ".join(value)
                if isinstance(value, dict)
                else f"0 … {len(value) - 1}"
                if isinstance(value, list)
                else "nothing"
            )
            where = ".".join(dotted.split(".")[:depth]) or "the outcome"
            raise KeyError(f"{dotted}: {where} has no {part!r}, it has {known}")
    return value


def check(scenario: Scenario, record: SortieRecord, result: dict[str, Any]) -> list[Verdict]:
    """Every expectation of the scenario, in its order."""
    return [
        *(_check_metric(e, result) for e in scenario.expect),
        *(_check_decision(e, record) for e in scenario.expect_decisions),
    ]


def _check_metric(expectation: Expectation, result: dict[str, Any]) -> Verdict:
    name = expectation.metric
    bounds = []
    if expectation.equals is not None:
        bounds.append(f"= {expectation.equals}")
    if expectation.at_least is not None:
        bounds.append(f"≥ {expectation.at_least:g}")
    if expectation.at_most is not None:
        bounds.append(f"≤ {expectation.at_most:g}")
    expected = f"{name} {' and '.join(bounds)}"
    try:
        got = metric(result, name)
    except KeyError as error:
        return Verdict(expected, error.args[0], False, expectation.because)
    holds = True
    if expectation.equals is not None:
        holds = got == expectation.equals or (
            isinstance(got, int | float)
            and isinstance(expectation.equals, int | float)
            and abs(got - expectation.equals) <= TOLERANCE
        )
    if expectation.at_least is not None or expectation.at_most is not None:
        number = isinstance(got, int | float) and not isinstance(got, bool)
        holds = (
            holds
            and number
            and (expectation.at_least is None or got >= expectation.at_least)
            and (expectation.at_most is None or got <= expectation.at_most)
        )
    shown = f"{got:.6g}" if isinstance(got, float) else str(got)
    return Verdict(expected, shown, holds, expectation.because)


def _check_decision(e: DecisionExpectation, record: SortieRecord) -> Verdict:
    """Between from_s and until_s some link of the drone is given what is expected, for the reason expected."""
    whom = f"drone {e.drone}" + ("" if e.peer is None else f" → {e.peer}")
    what = " ".join(
        [
            e.representation or "anything",
            *([f"at ≤ {e.rate_at_most_hz:g} Hz"] if e.rate_at_most_hz is not None else []),
            *([f"{'with' if e.roi else 'without'} ROI"] if e.roi is not None else []),
            *([f"because of {e.reason!r}"] if e.reason else []),
        ]
    )
    expected = f"{whom}: {what} decided in [{e.from_s:g}, {e.until_s:g}] s"
    rows = [
        r
        for r in record.tables["directives"].to_pylist()
        if e.from_s - TOLERANCE <= r["t_s"] <= e.until_s + TOLERANCE
        and r["drone"] == e.drone
        and (e.peer is None or r["peer"] == e.peer)
    ]
    for r in rows:
        if (
            (e.representation is None or r["representation"] == e.representation)
            and (e.rate_at_most_hz is None or r["rate_hz"] <= e.rate_at_most_hz)
            and (e.roi is None or (r["roi_radius_m"] == r["roi_radius_m"]) == e.roi)  # NaN is no ROI
            and e.reason in r["reason"]
        ):
            return Verdict(expected, _in_words(r), True, e.because)
    got = "; ".join(_in_words(r) for r in rows[:3]) or "no decision"
    return Verdict(expected, got, False, e.because)


def _in_words(row: dict[str, Any]) -> str:
    return f"{row['t_s']:.2f} s: {row['drone']} → {row['peer']} {describe(row)} ({row['reason']})"
