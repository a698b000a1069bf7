"""Frame times and memory of methods on the same bodies, in one process, in turn, so that none meets a quieter machine.

The pieces that use this clock: `bench_cases` (which networks, engines and solvers), `bench_growth` (cost against
nodes), `bench_training`, `bench_report` (tables and plots).
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError, RunRejected
from zsdt.tignn.engine import Engine
from zsdt.trajectory import Trajectory

Progress = Callable[[str], None]
ROUND_SECONDS, FEWEST = 0.3, 2  # what a turn of a slow method may take: it is timed on fewer frames, but on so many


@dataclass(frozen=True)
class Case:
    """One method on one trajectory: `make` gives its engine anew, `card` is what a row says of it beside its times."""

    make: Callable[[], Engine]
    trajectory: Trajectory
    card: Mapping[str, Any] = field(default_factory=dict)


def measure(
    cases: Sequence[Case], rounds: int = 3, frames: int = 20, warm: bool = True, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per case: its card, nodes, frame_dt_s, ms_p50, ms_p95, graph_ms_mean, peak_mb, timed_frames, threads.

    In every round each case predicts the first frames of its trajectory once, one after the other. Before the first
    round everything runs once (compilation, caches; not if `warm`ed before), then once more on a fresh engine for the
    peak of memory. A method that does not take its body is left out; one that refuses to go on is timed as far as it
    came.
    """
    able: list[tuple[Case, Engine, int, float]] = []
    for case in cases:
        found = _first_run(case, frames, warm)
        if found is not None:
            able.append((case, *found))
        if progress is not None:
            progress("warm-up")
    clocks: list[list[np.ndarray]] = [[] for _ in able]
    graphs: list[list[np.ndarray]] = [[] for _ in able]
    for _ in range(rounds):
        for k, (case, engine, count, _) in enumerate(able):
            times, graph = clock(engine, case.trajectory, count)
            clocks[k].append(times)
            graphs[k].append(graph)
            if progress is not None:
                progress(str(case.card.get("method", "")))
    return [
        _row(case, np.concatenate(times), np.concatenate(graph), peak)
        for (case, _, _, peak), times, graph in zip(able, clocks, graphs, strict=True)
    ]


def turns(cases: Sequence[Case], rounds: int) -> int:
    """How often `measure` reports progress at most."""
    return len(cases) * (rounds + 1)


def _first_run(case: Case, frames: int, warm: bool) -> tuple[Engine, int, float] | None:
    """The warm engine, how many frames it is timed on, and its peak of memory [MB]; None where it takes no such body.

    The peak is that of preparing the body and of two frames, beside the weights; NaN where the system does not say.
    """
    try:
        if warm:
            engine = case.make()
            engine.prepare(case.trajectory.body)
            clock(engine, case.trajectory, 2)
            del engine
        engine = case.make()
        before = _resident(reset=True)
        engine.prepare(case.trajectory.body)
        first = clock(engine, case.trajectory, 2)[0]
        peak = _resident(peak=True) - before
    except (OptionError, RunRejected):
        return None
    if not np.isfinite(first).any():
        return None
    count = min(frames, case.trajectory.frames - 1)
    pace = max(float(np.nanmin(first)), 1e-3)
    return engine, max(min(count, int(1e3 * ROUND_SECONDS / pace)), min(FEWEST, count)), peak


def clock(
    engine: Engine, trajectory: Trajectory, frames: int
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
    """Milliseconds of each step with its read-out, and of the graph in it, from the first frame of a trajectory on.

    The engine is prepared already. NaN from where it refuses.
    """
    times, graph = np.full(frames, np.nan), np.full(frames, np.nan)
    state = engine.start(trajectory.at(0), trajectory.load[0])
    for k in range(min(frames, trajectory.frames - 1)):
        began = time.perf_counter()
        try:
            state = engine.step(state, trajectory.load[k], trajectory.load[k + 1])
        except RunRejected:
            break
        engine.read(state)
        times[k] = 1e3 * (time.perf_counter() - began)
        graph[k] = getattr(engine, "graph_milliseconds", 0.0)
    return times, graph


def _resident(reset: bool = False, peak: bool = False) -> float:
    """Memory of this process [MB] from Linux: now, or its peak since the last reset. A reset gives back freed pages."""
    if reset:
        gc.collect()
        try:
            ctypes.CDLL(None).malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5")
        except (OSError, AttributeError):
            return math.nan
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return math.nan
    kilobytes = {name: value.split()[0] for name, _, value in (line.partition(":") for line in lines) if "kB" in value}
    return int(kilobytes["VmHWM" if peak else "VmRSS"]) / 1024.0


def _row(case: Case, times: np.ndarray, graph: np.ndarray, peak: float) -> dict[str, Any]:
    known = bool(np.isfinite(times).any())
    body = case.trajectory.body
    return {
        **case.card,
        "nodes": body.nodes,
        "frame_dt_s": body.frame_dt,
        "ms_p50": float(np.nanmedian(times)) if known else math.nan,
        "ms_p95": float(np.nanpercentile(times, 95)) if known else math.nan,
        "graph_ms_mean": float(np.nanmean(graph)) if known else math.nan,
        "peak_mb": peak,
        "timed_frames": int(np.isfinite(times).sum()),
        "threads": threads(),
    }


def threads() -> int:
    """Threads that a method may use in this process."""
    told = os.environ.get("OMP_NUM_THREADS", "")
    return int(told) if told.isdigit() and int(told) > 0 else len(os.sched_getaffinity(0))


def machine() -> str:
    """Processor, cores and threads of this process, for the line below a table."""
    return f"{_processor()}, {os.cpu_count()} cores, {threads()} thread(s) used"


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def grouped(cases: Sequence[Case]) -> Iterator[tuple[tuple[str, str], list[Case]]]:
    """Cases by scene and regime: those that take turns with each other."""
    keys = dict.fromkeys((str(case.card["scene"]), str(case.card["regime"])) for case in cases)
    for key in keys:
        yield key, [case for case in cases if (case.card["scene"], case.card["regime"]) == key]


def in_scenes(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[tuple[str, str], list[Mapping[str, Any]]]]:
    """Rows by scene and regime, in the order in which they first appear."""
    keys = dict.fromkeys((str(row["scene"]), str(row["regime"])) for row in rows)
    for key in keys:
        yield key, [row for row in rows if (row["scene"], row["regime"]) == key]
