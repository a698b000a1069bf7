"""Frame times of methods on the same bodies, in one process, in turn, so that no method meets a quieter machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.errors import OptionError
from zsdt.evaluation.plots import bars
from zsdt.evaluation.tables import write_csv
from zsdt.files import atomic_path
from zsdt.tignn.engine import Engine, roll_out
from zsdt.trajectory import Trajectory


def bench(
    engines: Mapping[str, Engine], trajectories: Sequence[Trajectory], rounds: int = 5, frames: int = 40
) -> list[dict[str, Any]]:
    """One row per method and trajectory: median and 95th percentile of milliseconds per frame over all rounds.

    In every round each method predicts the first `frames` frames of a trajectory once, one method after the other.
    A round before the first is not counted (compilation, caches). A method that does not fit a body is left out.
    `real_time`: seconds of the scene per second of computing, by the median. `graph_ms_mean`: what building graphs took
    on average, where they change.
    """
    rows = []
    for trajectory in trajectories:
        count = min(frames, trajectory.frames)
        start = replace(
            trajectory,
            times=trajectory.times[:count],
            fields={name: values[:count] for name, values in trajectory.fields.items()},
            load=trajectory.load[:count],
        )
        fitting = {name: engine for name, engine in engines.items() if _fits(engine, start)}
        clocks: dict[str, list[np.ndarray]] = {name: [] for name in fitting}
        graphs: dict[str, list[np.ndarray]] = {name: [] for name in fitting}
        for _ in range(rounds):
            for name, engine in fitting.items():
                rollout = roll_out(engine, start)
                clocks[name].append(rollout.milliseconds)
                graphs[name].append(rollout.graph_milliseconds)
        for name, parts in clocks.items():
            times = np.concatenate(parts)
            middle = float(np.nanmedian(times))
            rows.append(
                {
                    "method": name,
                    "trajectory": trajectory.name,
                    "nodes": trajectory.body.nodes,
                    "frame_ms": 1e3 * trajectory.body.frame_dt,
                    "ms_p50": middle,
                    "ms_p95": float(np.nanpercentile(times, 95)),
                    "graph_ms_mean": float(np.nanmean(np.concatenate(graphs[name]))),
                    "real_time": 1e3 * trajectory.body.frame_dt / middle,
                    "frames": int(np.isfinite(times).sum()),
                }
            )
    return rows


def _fits(engine: Engine, trajectory: Trajectory) -> bool:
    """Whether a method takes this body; runs it once, so that everything is compiled."""
    try:
        roll_out(engine, trajectory)
    except OptionError:
        return False
    return True


def machine() -> str:
    """Processor, cores and threads of this process, for the line below a table."""
    threads = os.environ.get("OMP_NUM_THREADS", str(os.cpu_count()))
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {threads} thread(s) used"


def markdown(rows: Sequence[Mapping[str, Any]], training: Sequence[Mapping[str, Any]]) -> str:
    """Both tables for people."""
    lines = ["| method | body | nodes | ms per frame (median / 95th) | times real time |", "|---|---|---:|---:|---:|"]
    if any(r["graph_ms_mean"] > 0 for r in rows):
        lines = [f"{line} {cell} |" for line, cell in zip(lines, ("of that graph, mean", "---:"), strict=True)]
    shares = [f" {r['graph_ms_mean']:.3g} |" if "graph" in lines[0] else "" for r in rows]
    lines += [
        f"| {r['method']} | {r['trajectory']} | {r['nodes']} | {r['ms_p50']:.3g} / {r['ms_p95']:.3g} "
        f"| {r['real_time']:.3g} |{share}"
        for r, share in zip(rows, shares, strict=True)
    ]
    lines += ["", "| trained | parameters | steps | seconds per 1,000 steps |", "|---|---:|---:|---:|"]
    lines += [
        f"| {t['method']} | {t.get('parameters', '-')} | {t.get('steps', '-')} | {t['seconds_per_1000_steps']:.3g} |"
        for t in training
    ]
    return "\n".join([*lines, "", f"{machine()}. Methods in turn, in one process.", ""])


def write_bench(folder: Path, rows: list[dict[str, Any]], training: list[dict[str, Any]]) -> Path:
    """Writes frames.csv, training.csv, bench.md and bench.png into `folder`; returns the Markdown file."""
    write_csv(folder / "frames.csv", rows)
    write_csv(folder / "training.csv", training)
    largest = max(rows, key=lambda row: row["nodes"])
    shown = {r["method"]: r["ms_p50"] for r in rows if r["trajectory"] == largest["trajectory"]}
    png = bars(shown, f"milliseconds per frame, {largest['nodes']} nodes", log=True)
    for name, content in (("bench.png", png), ("bench.md", markdown(rows, training).encode())):
        with atomic_path(folder / name) as beside:
            beside.write_bytes(content)
    return folder / "bench.md"
