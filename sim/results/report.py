"""A run as one self-contained HTML page: the scenario, the outcome, figures, and the decisions with their reasons."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sortie.scenarios.reading.load import dump
from sortie.scenarios.report_text import number, percent, size
from sortie.scenarios.schema import Fleet, GroundStation
from sortie.sim.folders import write_text
from sortie.sim.results.blocks import Block, Code, Figure, Heading, Items, Paragraph, Table, Tiles, html_page
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.report_figures import colour, figures, moments
from sortie.sim.results.sentences import decision_in_words, event_in_words, losses_in_words, turns_in_words
from sortie.sim.results.summary import PLURAL

MOST_EVENTS = 30
"""Listed above the figures; the table of decisions has all."""


def save_page(record: SortieRecord, path: Path) -> None:
    """Write a run's page; it is there whole or not at all.

    Raises:
        RunError: the file cannot be written, or matplotlib is not installed.
    """
    write_text(path, page(record))


def page(record: SortieRecord) -> str:
    """A run's page as HTML: no script, and nothing fetched from anywhere."""
    return html_page(list(_blocks(record)))


def _blocks(record: SortieRecord) -> Iterator[Block]:
    result, scenario = outcome(record), record.scenario
    yield Heading(f"{scenario.name} under {record.policy}", 1)
    yield Paragraph(
        f"{scenario.fleet.drones} drones, {scenario.duration_s:g} s, seed {record.seed}, Sortie {record.version}"
    )
    yield Paragraph(scenario.description)
    yield Tiles(_tiles(result))
    yield Heading("What happened")
    yield Paragraph(
        "Dashed lines: the mission's phase changes. Dotted lines: something happened to the fleet, by number:"
    )
    yield Items(_happened(record) or ["nothing"])
    yield from (Figure(caption, svg=svg) for caption, svg in figures(record).items())
    yield Heading("Who decided what, and why")
    yield _decisions(result)
    yield Heading("In numbers")
    yield from _numbers(result, scenario.fleet)
    yield Code(dump(scenario), folded="The scenario as it was flown")
    if own := "\n".join(f"{name}  {digest}" for name, digest in result["own_files"].items()):
        yield Code(own, folded="Own files, SHA-256")
    yield Paragraph(
        f"Fingerprint {result['fingerprint']}: the same scenario, policy, seed and version give the same one."
    )


def _happened(record: SortieRecord) -> list[str]:
    """The events by the numbers that they have in the figures."""
    events = moments(record)
    items = [f"**{k}** {t_s:g} s: {'; '.join(texts)}" for k, (t_s, texts) in enumerate(events[:MOST_EVENTS], start=1)]
    more = len(events) - MOST_EVENTS
    return [*items, f"and {more} more in the table below"] if more > 0 else items


def _tiles(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The few figures that a reader takes home: name, value, what it is of."""
    ap, data, mission = result["ap50"], result["bytes"], result["mission"]
    tiles = []
    whole = mission["flown_share"] == 1.0
    if not whole:
        tiles.append(("Flown", percent(mission["flown_share"]), "of drone-seconds"))
    if ap["detector"] != "none":
        by = f"the surrogate {ap['calibration']}" if ap["calibration"] else f"the {ap['detector']} detector"
        blind = ap["grounded_blind"]
        notes = [f"AP@0.5, {by}", f"{ap['scored_fusions']} fusions scored"]
        if not whole:
            notes = [f"{number(blind[area])} with grounded drones blind" for area in ("mission", "full_scene")]
        notes[1] += turns_in_words(ap)
        tiles.append(("Accuracy, mission disc", number(ap["mission"]), notes[0]))
        tiles.append(("Accuracy, full scene", number(ap["full_scene"]), notes[1]))
        for name, of_class in result["ap_by_class"].items():
            if name != "car" and of_class["full_scene"] is not None:
                note = "full scene, by distance" if name == "person" else "full scene, AP@0.5"
                tiles.append((f"Accuracy, {PLURAL[name]}", number(of_class["full_scene"]), note))
    people = result["people"]
    if people["located_share"] is not None:
        alone = f"in drones' regions, {percent(people['located_alone_share'])} by own cameras"
        tiles.append(("People located", percent(people["located_share"]), alone))
    if mission["region_observed_share"] is not None:
        tiles.append(("Region in view", percent(mission["region_observed_share"]), "of its area, mean over time"))
    if mission["target_in_view_share"] is not None:
        gap = f"of the time, longest gap {mission['target_longest_out_of_view_s']:.1f} s"
        tiles.append(("Target in view", percent(mission["target_in_view_share"]), gap))
    if mission["target_detected_share"] is not None:
        gap = f"of the time, longest gap {mission['target_longest_undetected_s']:.1f} s"
        tiles.append(("Target detected", percent(mission["target_detected_share"]), gap))
    least = min(result["battery"].values(), default=None)
    return [
        *tiles,
        ("Data delivered", size(data["data_delivered"]), f"of {size(data['data_sent'])} sent"),
        (
            "Deadlines missed",
            percent(result["deadline_miss_rate"]),
            f"channel busy {percent(result['medium_busy_fraction'])}",
        ),
        ("Context plane", size(data["context_sent"]), f"{percent(result['context_share'])} of all bytes"),
        ("Descriptors lost", percent(result["context"]["lost"]), losses_in_words(result["context"]) or "of receptions"),
        ("Energy", f"{result['energy_j']['total'] / 1e3:.1f} kJ", f"least charge left {percent(least)}"),
        *(
            (f"metrics.{name}", number(value, ".4g"), "a metric of your own")
            for name, value in result["metrics"].items()
        ),
    ]


def _decisions(result: dict[str, Any]) -> Block:
    """Decisions and events in one table, in order of time; decisions have their drone's colour."""
    rows = [(t["t_s"], colour(t["drone"]), decision_in_words(t)) for t in result["transitions"]]
    rows += [(e["t_s"], "", event_in_words(e)) for e in result["events"]]
    rows.sort(key=lambda row: row[0])
    if not rows:
        return Paragraph("Nobody ever sent anything, and nothing happened to the fleet.")
    return Table((), [(f"{t_s:.2f} s", text) for t_s, _, text in rows], [ink for _, ink, _ in rows])


def _numbers(result: dict[str, Any], fleet: Fleet) -> tuple[Table, Table]:
    """Phases, then drones and ground stations."""
    phases = [
        (
            f"{p['phase']}, {p['begin_s']:g}–{p['end_s']:g} s",
            number(p["ap50"]["full_scene"]),
            number(p["ap50"]["mission"]),
            f"{p['data_rate_mbps']:.1f} Mb/s",
            percent(p["deadline_miss_rate"]),
            percent(p["context"]["lost"]),
        )
        for p in result["phases"]
    ]
    drones = [_drone_row(i, d, fleet.station(int(i))) for i, d in result["drones"].items()]
    return (
        Table(("phase", "AP full scene", "AP mission", "data", "deadlines missed", "descriptors lost"), phases),
        Table(("drone", "charge left", "energy", "voltage", "AP full scene", "AP mission", "at the end"), drones),
    )


def _drone_row(drone_id: str, drone: dict[str, Any], station: GroundStation | None) -> list[str]:
    """A drone or a ground station at the end."""
    energy = [percent(drone["soc"]), f"{drone['energy_j'] / 1e3:.1f} kJ", f"{drone['voltage_v']:.2f} V"]
    if station is not None and station.mains:
        energy = ["mains", "", ""]
    name, up, down = ("drone", "flying", "down") if station is None else ("station", "on", "off")
    accuracy = [number(drone["ap50"][area]) for area in ("full_scene", "mission")]
    return [f"{name} {drone_id}", *energy, *accuracy, up if drone["airborne"] else down]
