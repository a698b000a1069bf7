"""Frame times of the closed loops by part, in one process and in turn: what a twin costs on one core and on two.

Beam: picture to decoded fields. Glass: the same; prediction on a thread of its own beside segmentation ("beside") or
after it ("in turn"), with the particle engine in double and in single precision. Weights are those that are shipped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from zsdt.errors import DataError
from zsdt.evaluation.beam_twin_cases import Case, scene_of
from zsdt.evaluation.glass_twin_cases import GlassCase, GlassTwinEvaluationOptions, glass_scene_of
from zsdt.evaluation.tables import write_csv
from zsdt.files import atomic_path
from zsdt.interop.inference import with_backend
from zsdt.lab.clips import read_clip
from zsdt.lab.glass_clips import read_glass_clip
from zsdt.perception.glass_segmentation import load_glass_segmenter
from zsdt.perception.segmentation import SegmentationBackend, load_segmenter
from zsdt.shipped import shipped
from zsdt.tignn.engine import load_engine
from zsdt.tignn.inference import InferenceBackend
from zsdt.tignn.psi_ini import load as load_psi_ini
from zsdt.twin.glass_loop import GlassTwinOptions, run_glass_twin
from zsdt.twin.loop import TwinOptions, run_twin

WARM_UP = 5  # frames after the first ones with a body, before the clock counts
BEAM, GLASS = "foam_beam", "glycerin_glass"
PARTS = ("capture", "track", "segment", "observe", "predict", "correct", "decode", "total")
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class TwinCase:
    """One way to run a twin over its clips: `run(clip folder)` gives its log."""

    twin: str
    name: str
    threads: int
    run: Callable[[Path], Any]


def beam_cases(threads: Sequence[int]) -> list[TwinCase]:
    """The beam's closed loop, on so many threads of OpenCV and torch."""
    weights = {part: shipped(BEAM, part) for part in ("vision", "tignn", "psi_ini")}
    engine, psi_ini = load_engine(weights["tignn"]), load_psi_ini(weights["psi_ini"])
    segmenter = load_segmenter(weights["vision"], SegmentationBackend.eager)

    def run(folder: Path) -> Any:
        clip = read_clip(folder)
        return run_twin(
            clip.source(), segmenter, scene_of(clip, Case.closed), TwinOptions(keep_fields=False),
            camera=clip.camera, engine=engine, psi_ini=psi_ini,
        )  # fmt: skip

    return [TwinCase("beam", "closed", count, run) for count in threads]


def glass_cases(threads: Sequence[int], particles: int) -> list[TwinCase]:
    """The glass's closed loop in double and in single precision, in turn and beside the segmentation."""
    weights = {part: shipped(GLASS, part) for part in ("vision", "tignn", "psi_ini")}
    psi_ini, loaded = load_psi_ini(weights["psi_ini"]), load_engine(weights["tignn"])
    given = GlassTwinEvaluationOptions(particles=particles)
    segmenters: dict[int, Any] = {}

    def case(count: int, backend: InferenceBackend, beside: bool) -> TwinCase:
        engine: Any = with_backend(loaded, backend)
        loop = GlassTwinOptions(beside=beside, keep_fields=False)

        def run(folder: Path) -> Any:
            if count not in segmenters:  # OpenVINO takes the threads that torch has when a picture first comes
                segmenters[count] = load_glass_segmenter(weights["vision"], given.backend)
            clip = read_glass_clip(folder)
            return run_glass_twin(
                clip.source(), segmenters[count], glass_scene_of(clip, GlassCase.closed, given.particles), loop,
                camera=clip.camera, engine=engine, psi_ini=psi_ini,
            )  # fmt: skip

        precision = "single" if backend is InferenceBackend.kernel else "double"
        return TwinCase("glass", f"{precision}, {'beside' if beside else 'in turn'}", count, run)

    kernel, eager = InferenceBackend.kernel, InferenceBackend.eager
    return [
        case(count, backend, beside)
        for count in threads
        for backend, beside in ((kernel, True), (eager, True), (kernel, False))
    ]


def time_twins(
    cases: Sequence[TwinCase], clips: Mapping[str, Sequence[Path]], rounds: int = 1, progress: Callable | None = None
) -> tuple[Rows, Rows]:
    """Rows of parts (twin, case, threads, part, p50, p95, p99, max [ms], worst clip's p99, frames, nodes) and rows of
    the beginnings (twin, case, threads, part, median ms). Every clip is run by all cases in turn, `rounds` times after
    a first run of each that only warms up."""
    frames: dict[int, list[dict[str, np.ndarray]]] = {k: [] for k in range(len(cases))}
    starts: dict[int, list[dict[str, float]]] = {k: [] for k in range(len(cases))}
    nodes: dict[int, list[int]] = {k: [] for k in range(len(cases))}
    for turn in range(rounds + 1):
        for place in range(max(len(mine) for mine in clips.values()) if turn else 1):
            for k, case in enumerate(cases):
                mine = clips.get(case.twin, ())
                if place >= len(mine):
                    continue
                torch.set_num_threads(case.threads)
                cv2.setNumThreads(case.threads)
                log = case.run(mine[place])
                if progress is not None:
                    progress(f"{case.twin} {case.name}")
                if turn == 0:
                    continue
                frames[k].append(_frames_of(log))
                starts[k].append(dict(log.start_ms))
                nodes[k].append(log.body.nodes)
    rows, begun = [], []
    for k, case in enumerate(cases):
        card = {"twin": case.twin, "case": case.name, "threads": case.threads}
        rows += [{**card, **row, "nodes": _span(nodes[k])} for row in _percentiles(frames[k])]
        names = dict.fromkeys(name for start in starts[k] for name in start)
        begun += [
            {**card, "part": name, "ms": float(np.median([s[name] for s in starts[k] if name in s]))} for name in names
        ]
    return rows, begun


def _frames_of(log: Any) -> dict[str, np.ndarray]:
    """Milliseconds of each part in the frames that count; `total` without reading the video."""
    first = getattr(log, "start", 0) + WARM_UP
    parts = {name: np.asarray(values)[first:] for name, values in log.latency.items()}
    whole = getattr(log, "whole", None)
    if whole is None:
        whole = np.nansum([v for name, v in log.latency.items() if name != "capture"], axis=0)
    return {**parts, "total": np.asarray(whole)[first:]}


def _percentiles(runs: Sequence[Mapping[str, np.ndarray]]) -> Rows:
    rows = []
    for part in PARTS:
        found = [run[part][np.isfinite(run[part])] for run in runs if part in run]
        together = np.concatenate(found) if found else np.zeros(0)
        if not len(together):
            continue
        p50, p95, p99 = (float(x) for x in np.percentile(together, [50, 95, 99]))
        worst = max(float(np.percentile(x, 99)) for x in found if len(x))
        rows.append(
            {"part": part, "p50": p50, "p95": p95, "p99": p99, "max": float(together.max()), "worst_clip_p99": worst,
             "frames": len(together)}
        )  # fmt: skip
    return rows


def _span(counts: Sequence[int]) -> str:
    return f"{min(counts)} to {max(counts)}" if counts else "0"


def write_twin_report(folder: Path, rows: Rows, begun: Rows, origin: str) -> Path:
    """`bench_twins.csv`, `bench_twins_start.csv` and the page `bench_twins.md`, whose path it gives.

    Raises: DataError where nothing was timed.
    """
    if not rows:
        raise DataError("No clip was timed; name folders of clips.")
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "bench_twins.csv", rows)
    write_csv(folder / "bench_twins_start.csv", begun)
    lines = ["# Frame times of the twins by part", "", origin, ""]
    for twin in dict.fromkeys(row["twin"] for row in rows):
        mine = [row for row in rows if row["twin"] == twin]
        total = next(row for row in mine if row["part"] == "total")
        lines += [
            f"## {twin.capitalize()}, {total['nodes']} nodes, {total['frames']} frames a case, milliseconds", "",
            "| case | threads | part | p50 | p95 | p99 | p99 of the worst clip |", "|---|---|---|---|---|---|---|",
        ]  # fmt: skip
        for row in mine:
            numbers = " | ".join(f"{row[name]:.2f}" for name in ("p50", "p95", "p99", "worst_clip_p99"))
            lines.append(f"| {row['case']} | {row['threads']} | {row['part']} | {numbers} |")
        lines += [
            "",
            "The beginning (median over the clips):",
            "",
            "| case | threads | part | ms |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {row['case']} | {row['threads']} | {row['part']} | {row['ms']:.0f} |"
            for row in begun
            if row["twin"] == twin
        ]
        lines.append("")
    page = folder / "bench_twins.md"
    with atomic_path(page) as beside:
        beside.write_text("\n".join(lines))
    return page
