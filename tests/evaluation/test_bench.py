"""The bench lets methods take turns, leaves out what does not fit, and counts every frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from zsdt.errors import OptionError
from zsdt.evaluation.baselines import StaticBaseline
from zsdt.evaluation.bench import bench, write_bench
from zsdt.graph import brick_grid
from zsdt.trajectory import Body, Trajectory


class Named(StaticBaseline):
    """Nothing moves, but it says when it is asked."""

    def __init__(self, name: str, asked: list[str]):
        self.name, self.asked = name, asked

    def prepare(self, body: Body) -> None:
        """Notes its turn; does not take bodies of more than 12 nodes if its name says so."""
        self.asked.append(self.name)
        if self.name == "small" and body.nodes > 12:
            raise OptionError("Too large.")


def still(length: int) -> Trajectory:
    """A beam of `length` cells at rest, six frames."""
    grid = brick_grid((length, 1, 1), 0.05)
    nodes = len(grid.points)
    body = Body(grid.points, grid.pairs, grid.points[:, 0] == 0, np.ones(nodes), 0.01, 0.05, cells=grid.cells)
    fields = {"position": grid.points, "velocity": np.zeros((nodes, 3)), "stress": np.zeros((nodes, 6))}
    frames = {name: np.repeat(values[None], 6, axis=0) for name, values in fields.items()}
    return Trajectory(body, 0.01 * np.arange(6), frames, np.zeros((6, nodes, 3)), meta={"name": f"still_{length}"})


def test_methods_take_turns_and_every_frame_counts(tmp_path: Path) -> None:
    asked: list[str] = []
    engines = {name: Named(name, asked) for name in ("one", "small")}
    rows = bench(engines, [still(2), still(4)], rounds=3, frames=4)
    assert asked == ["one", "small"] * 4 + ["one", "small", "one", "one", "one"]
    assert [(row["method"], row["nodes"], row["frames"]) for row in rows] == [
        ("one", 12, 9),
        ("small", 12, 9),
        ("one", 20, 9),
    ]
    assert all(row["ms_p50"] <= row["ms_p95"] for row in rows)
    page = write_bench(tmp_path, rows, [{"method": "one", "seconds_per_1000_steps": 12.0}])
    assert "| one | still_4 | 20 |" in page.read_text()
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")
