"""The page of `make bench`: what it makes of measured seconds."""

from __future__ import annotations

from research.validation.bench_page import Item, measure, page


def test_ratios_are_over_the_peer_real_time_and_the_scaled_release() -> None:
    items = [
        Item("flight", lambda: None, 10.0, "ns-3", lambda: 8.0),
        Item("no peer here", lambda: None, 4.0, "GrADyS-SIM"),
        Item("a moment", lambda: None, 0.0),
    ]
    found = {"flight": (0.5, 8.0), "no peer here": (2.0, None), "a moment": (0.1, None)}
    release = {"sortie": "0.2.0", "host_s": 0.02, "seconds": {"flight": 0.2, "a moment": 0.05}}
    table = page(items, found, release, host_s=0.04)  # this machine takes twice as long for all
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["flight"] == [0.5, 20.0, "ns-3", 8.0, 16.0, 1.25]
    assert rows["no peer here"] == [2.0, 2.0, "GrADyS-SIM", None, None, None]
    assert rows["a moment"] == [0.1, None, None, None, None, 1.0]
    assert table.columns[-1].name == "time relative to 0.2.0"
    assert "Not installed here: GrADyS-SIM." in table.about
    assert "ns-3" not in table.about


def test_each_figure_runs_once_before_it_is_measured_and_its_peer_in_the_same_call() -> None:
    calls: list[str] = []

    def peer_s() -> float:
        calls.append("peer")
        return 3.0

    found = measure([Item("it", lambda: calls.append("own"), 1.0, "ns-3", peer_s)], calls.append)
    assert calls == ["it", *["own"] * 4, "peer"]
    own_s, other_s = found["it"]
    assert (own_s >= 0.0, other_s) == (True, 3.0)
