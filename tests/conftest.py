"""Options of the suite, and its report of what took long: files over 5 s of processor time, and each worker's memory."""

from __future__ import annotations

import resource
import time
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import pytest
import suite_settings  # noqa: F401 (it sets what it names)

LONG_S = 5.0
times_s: defaultdict[str, float] = defaultdict(float)
"""Processor time by file, of this process and of the children that it waited for."""
peaks_mb: list[float] = []
"""The most memory that each process of the suite has held."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update-golden", action="store_true", help="Write golden outcomes anew instead of comparing.")


def spent_s() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    begin_s = spent_s()
    try:
        return (yield)
    finally:
        times_s[item.nodeid.partition("::")[0]] += spent_s() - begin_s


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    output = getattr(session.config, "workeroutput", None)  # a worker of pytest-xdist hands its figures over
    if output is not None:
        output |= {"times_s": dict(times_s), "peak_mb": peak_mb}
    elif not peaks_mb:
        peaks_mb.append(peak_mb)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    output = getattr(node, "workeroutput", {})
    for file, s in output.get("times_s", {}).items():
        times_s[file] += s
    if "peak_mb" in output:
        peaks_mb.append(output["peak_mb"])


def pytest_terminal_summary(terminalreporter: Any) -> None:
    long = sorted(((s, file) for file, s in times_s.items() if s > LONG_S), reverse=True)
    terminalreporter.section(f"files over {LONG_S:g} s of processor time", sep="-")
    for s, file in long:
        terminalreporter.write_line(f"{s:7.1f} s  {file}")
    peaks = ", ".join(f"{peak:,.0f}" for peak in peaks_mb)
    terminalreporter.write_line(f"{sum(times_s.values()):7.1f} s  in all; at most {peaks} MB of memory in each process")
