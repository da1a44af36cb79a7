"""The table of difficulties: which scenes are evaluated under which move, and which of their figures are compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
import torch

from research.benchmark.difficulty import Difficulty
from research.benchmark.scenes import draw_captures, draw_scene, model_of
from research.paper import difficulty_effects as effects
from sortie.perception.geometry import FULL
from sortie.perception.metrics.ap import Matched
from sortie.perception.metrics.bootstrap import compare


def unit(*key: int) -> Matched:
    """Made detections of one ego: scene, move, condition, ego."""
    rng = np.random.default_rng(key)
    return Matched(np.sort(rng.random(6))[::-1], rng.random(6) < 0.3 + 0.2 * key[2] - 0.02 * key[1], 5 + key[0])


def save(path: Path, scene: int, moves: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    keys = [(r, c, e) for r in range(moves) for c in (0, 1) for e in (0, 1, 2)]
    np.savez(
        path,
        **{
            f"{r}.{c}.{e}.{f}": getattr(unit(scene, r, c, e), f) for r, c, e in keys for f in ("score", "hit", "truths")
        },
    )


class AtOnce:
    """A pool that does what it is given when it is given."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def submit(self, do: Callable[..., None], *what: Any) -> Any:
        do(*what)
        return SimpleNamespace(result=lambda: None)

    def shutdown(self, **_: Any) -> None: ...


def test_each_move_is_compared_with_no_move_by_scenes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A scene that is there already is not evaluated anew; egos of one scene stand or fall together."""
    rows = effects.moves()[:4]
    made: list[int] = []

    def evaluate_scene(_: Path, k: int, moves: Sequence[Any], path: Path) -> None:
        made.append(k)
        save(path, k, len(moves))

    monkeypatch.setattr(effects, "moves", lambda: rows)
    monkeypatch.setattr(effects, "evaluate_scene", evaluate_scene)
    monkeypatch.setattr(effects, "ProcessPoolExecutor", AtOnce)
    monkeypatch.setattr(effects, "as_completed", list)
    monkeypatch.setattr(effects.CarNetInstrument, "load", lambda _: SimpleNamespace(fingerprint="made"))
    done: list[tuple[int, int]] = []
    effects.measure(Path("none"), tmp_path, scenes=2, progress=lambda *n: done.append(n))
    assert (made, done) == ([0, 1], [(1, 2), (2, 2)])
    (folder,) = tmp_path.iterdir()
    (folder / "scene_0.npz").unlink()
    found = effects.measure(Path("none"), tmp_path, scenes=4)
    assert made == [0, 1, 0, 2, 3]
    with monkeypatch.context() as other:
        other.setattr(effects, "boxes_digest", lambda: "another")
        effects.measure(Path("none"), tmp_path, scenes=1)
    assert made == [0, 1, 0, 2, 3, 0], "another code evaluates anew"
    label = np.repeat(np.arange(4), 3)

    def units(r: int, c: int) -> list[Matched]:
        return [unit(k, r, c, e) for k in range(4) for e in range(3)]

    assert [e.move for e in found] == rows
    for r, effect in enumerate(found):
        assert effect.gain == compare(units(r, 0), units(r, 1), label)
        assert effect.change == (compare(units(0, 1), units(r, 1), label) if r else None)


def test_a_scene_is_drawn_and_flown_as_each_move_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Poses true and believed are each row's own, and so are the cars of its town at the moment of the capture."""
    moved = [Difficulty(), replace(Difficulty(), position_error_sigma_m=0.5), replace(Difficulty(), density="dense")]
    rows = [effects.ParameterShift("made", str(k), d) for k, d in enumerate(moved)]
    seen: list[Any] = []

    def evaluate(_: Any, frames: Any, conditions: Any, *, regions: Any) -> Any:
        seen.append(frames)
        r = len(seen) - 1
        return SimpleNamespace(matched=lambda c: [unit(5, r, conditions.index(c), e) for e in range(2)])

    monkeypatch.setattr(effects, "evaluate", evaluate)
    monkeypatch.setattr(effects, "lift", lambda views, captures, geometry: torch.zeros(len(captures), 1))
    monkeypatch.setattr(effects.Renderer, "render", lambda *_: None)
    monkeypatch.setattr(effects.CarNetInstrument, "load", lambda _: SimpleNamespace(geometry=FULL))
    effects.evaluate_scene(Path("none"), 5, rows, tmp_path / "scene.npz")
    for frames, d in zip(seen, moved, strict=True):
        captures = draw_captures(effects.SEED, "test", 5, 0, d)
        np.testing.assert_array_equal(frames.true_pose, [[c.true_pose for c in captures]])
        np.testing.assert_array_equal(frames.est_pose, [[c.est_pose for c in captures]])
        cars = model_of(draw_scene(effects.SEED, "test", 5, d)).cars_at(captures[0].t_s).table()
        np.testing.assert_array_equal(frames.cars, cars[None])
        assert frames.scene.tolist() == [5]
    read = effects._read(tmp_path / "scene.npz", 3)
    for r in range(3):
        for c in range(2):
            for e in range(2):
                got, wanted = read[r][c][e], unit(5, r, c, e)
                assert (got.score.tolist(), got.hit.tolist(), got.truths) == (
                    wanted.score.tolist(),
                    wanted.hit.tolist(),
                    wanted.truths,
                )
