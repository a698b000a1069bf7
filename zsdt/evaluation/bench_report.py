"""Tables and plots of the benchmark: CSV for machines, Markdown and PNG for people, worst rows shown like the best."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from zsdt.evaluation import plots
from zsdt.evaluation.bench import in_scenes, machine
from zsdt.evaluation.bench_cases import TIME_ONLY
from zsdt.evaluation.bench_growth import FRAME_SECONDS, SIZES, fit_growth
from zsdt.evaluation.bench_words import cell, known, percent, plain, table, three
from zsdt.evaluation.pareto import pareto_front
from zsdt.evaluation.tables import write_csv
from zsdt.files import atomic_path

Rows = Sequence[Mapping[str, Any]]
ERROR = "displacement_rrmse"
ASKED_EXPONENT = 1.1


@dataclass(frozen=True)
class Results:
    """All tables of a run: points (methods on bodies), ratio (seed's network against exact form), growth and its
    exponents, training."""

    points: Rows
    ratio: Rows
    growth: Rows
    exponents: Rows
    training: Rows


def with_front(rows: Rows) -> list[dict[str, Any]]:
    """The rows with `front`: 1 where no other method of the scene and regime is better in milliseconds and error.

    The picture in which nothing moves costs nothing; it is a level, not a point.
    """
    found: list[dict[str, Any]] = []
    for _, mine in in_scenes(rows):
        costs = [[row["ms_p50"], math.nan if row["method"] == plots.NOTHING_MOVES else row[ERROR]] for row in mine]
        front = pareto_front(np.array(costs, float).reshape(-1, 2))
        found += [{**row, "front": int(on)} for row, on in zip(mine, front, strict=True)]
    return found


def write_report(folder: Path, results: Results, origin: str) -> Path:
    """Writes bench_points.csv, bench_ratio.csv, bench_growth.csv, bench_exponents.csv, bench_training.csv, bench.md,
    and the plots bench_pareto.png, bench_memory.png, bench_growth.png; returns the Markdown file."""
    for name in ("points", "ratio", "growth", "exponents", "training"):
        write_csv(folder / f"bench_{name}.csv", [dict(row) for row in getattr(results, name)])
    written = {
        "bench_pareto.png": pareto_plot(results.points, "ms_p50", "milliseconds per frame"),
        "bench_memory.png": pareto_plot(results.points, "peak_mb", "peak memory [MB]"),
        "bench_growth.png": growth_plot(results.growth),
        "bench.md": page(results, origin).encode(),
    }
    for name, content in written.items():
        with atomic_path(folder / name) as beside:
            beside.write_bytes(content)
    return folder / "bench.md"


def page(results: Results, origin: str) -> str:
    """The page: the claims first, then every method, then what was only timed."""
    parts = ["# Speed against error", origin, f"{machine()}. Methods in turn, in one process."]
    parts += ["## The seed's network to the letter against the exact form", RATIO_NOTE, ratio_table(results.ratio)]
    parts += ["## Cost against nodes", GROWTH_NOTE, growth_table(results), "![Cost against nodes](bench_growth.png)"]
    parts += ["## Every method that has an error", POINT_NOTE, "![Speed against error](bench_pareto.png)"]
    for (scene, regime), mine in in_scenes([row for row in results.points if row["trained"]]):
        parts += [f"### {scene}, {regime}", point_table(mine)]
    parts.append("![Memory against error](bench_memory.png)")
    timed = [row for row in results.points if row["note"] == TIME_ONLY]
    if timed:
        parts += ["## Widths, passes, brackets, context: time only", TIME_NOTE]
        parts += [f"### {scene}\n\n{grid_table(mine)}" for (scene, _), mine in in_scenes(timed)]
    parts += ["## Training", TRAINING_NOTE, training_table(results.training)]
    return "\n\n".join(parts) + "\n"


RATIO_NOTE = (
    "Same graph, same threads, all of a frame (graph of the moment, network, read-out). Errors are of full rollouts of "
    "trained networks, each after the steps and CPU-minutes beside it; `-`: no error was measured. The seed's network "
    "has 7 passes of 2 x 100 with shared weights, which gives its 299,663 parameters on the liquid; own weights for "
    "every pass are timed as well. Third: stress of beams, internal energy since the first frame of liquids."
)
GROWTH_NOTE = (
    "Larger bodies at one pitch, and the same body on finer and finer grids (marked), where explicit sub-steps get "
    "shorter with the pitch. Fitted as ms = a nodes^b from 1,000 nodes on; `off by` is the largest factor between a "
    f"point and the fit. Asked: b <= {ASKED_EXPONENT}. A method stops where its next size would take over "
    f"{FRAME_SECONDS:g} s a frame."
)
POINT_NOTE = (
    "RRMSE in percent over whole rollouts, mean (worst) over n trajectories of the evaluation; milliseconds and memory "
    "are of one of their bodies. `*`: on the Pareto front of its table. Sorted by error, the worst last; 100 is a "
    "picture in which nothing moves. Backends share the error of their network (equal to 1e-5 or better)."
)
TIME_NOTE = "Untrained networks: milliseconds per frame (peak MB) by passes and width. They have no error and no front."
TRAINING_NOTE = "One-step training with a batch of 2, measured on a few steps; push-forward adds a forward pass a step."


def ratio_table(rows: Rows) -> str:
    """The claim: one row a method, by graph."""
    head = ["graph", "method", "ms per frame", "times faster", "MB", "displacement %", "velocity %", "third %",
            "training steps", "CPU minutes"]  # fmt: skip
    lines = []
    for row in rows:
        third = row.get("stress_rrmse", row.get("energy_increment_rrmse"))
        lines.append(
            [
                f"{row['graph']}: {row['nodes']:,} nodes, {row['pairs']:,} pairs",
                row["method"],
                f"{three(row['ms_p50'])} / {three(row['ms_p95'])}",
                "1" if row["method"] == "seed_literal" else three(row["times_faster"]),
                three(row["peak_mb"]),
                *(percent(row.get(name)) for name in (ERROR, "velocity_rrmse")),
                percent(third),
                plain(row.get("steps")),
                three(row.get("cpu_minutes", math.nan)),
            ]
        )
    return table(head, lines)


def growth_table(results: Results) -> str:
    """Milliseconds by size, and the exponent."""
    sizes = sorted({_round_size(row["nodes"]) for row in results.growth})
    lines = []
    for law in results.exponents:
        mine = [r for r in results.growth if (r["scene"], r["method"]) == (law["scene"], law["method"])]
        by_size = {_round_size(row["nodes"]): row["ms_p50"] for row in mine}
        missed = " (!)" if law["exponent"] > ASKED_EXPONENT else ""
        lines.append(
            [law["scene"], law["method"], *(three(by_size.get(s, math.nan)) for s in sizes),
             f"{three(law['exponent'])}{missed}", f"x {three(law['worst_factor'])}"]
        )  # fmt: skip
    return table(["scene", "method", *(f"{s:,}" for s in sizes), "exponent b", "off by"], lines)


def _round_size(nodes: int) -> int:
    """The size that was meant: bodies of whole cells have a few nodes more or less."""
    return min(SIZES, key=lambda size: abs(math.log(size / nodes)))


def point_table(rows: Rows) -> str:
    """Methods with errors, best first."""
    third = "stress_rrmse" if any(known(r.get("stress_rrmse")) for r in rows) else "energy_increment_rrmse"
    head = ["method", "passes", "width", "backend", "pitch mm", "nodes", "pairs", "ms per frame (p50 / p95)", "peak MB",
            "displacement %", "velocity %", f"{third.removesuffix('_rrmse').replace('_', ' ')} %", "n", ""]  # fmt: skip
    lines = []
    for row in sorted(rows, key=lambda r: (r[ERROR], r["ms_p50"])):
        lines.append(
            [
                f"{row['method']}{' *' if row.get('front') else ''}",
                *(plain(row[name]) for name in ("passes", "width", "backend")),
                three(1e3 * row["pitch_m"]),
                *(plain(row[name]) for name in ("nodes", "pairs")),
                f"{three(row['ms_p50'])} / {three(row['ms_p95'])}",
                three(row["peak_mb"]),
                *(cell(row, n) for n in (ERROR, "velocity_rrmse", third)),
                plain(row["trajectories"]),
                row["note"],
            ]
        )
    return table(head, lines)


def grid_table(rows: Rows) -> str:
    """Milliseconds (MB) of untrained networks: a row a bracket and depth, a column a width."""
    widths = sorted({int(r["width"]) for r in rows})
    keys = dict.fromkeys((r["method"], r["context"], r["passes"]) for r in rows)
    lines = []
    for method, context, passes in keys:
        cells = {
            int(r["width"]): f"{three(r['ms_p50'])} ({three(r['peak_mb'])})"
            for r in rows
            if (r["method"], r["context"], r["passes"]) == (method, context, passes)
        }
        lines.append([method, "yes" if context else "no", plain(passes), *(cells.get(w, "-") for w in widths)])
    shape = f"{rows[0]['nodes']:,} nodes, {rows[0]['pairs']:,} pairs"
    return f"{shape}.\n\n" + table(["network", "context", "passes", *(f"width {w}" for w in widths)], lines)


def training_table(rows: Rows) -> str:
    """Seconds per 1,000 steps."""
    head = ["scene", "network", "passes", "width", "parameters", "nodes", "seconds per 1,000 steps"]
    names = ("scene", "method", "passes", "width", "parameters", "nodes")
    return table(head, [[*(plain(r[n]) for n in names), three(r["seconds_per_1000_steps"])] for r in rows])


def pareto_plot(rows: Rows, cost: str, label: str) -> bytes:
    """Displacement error against a cost, a panel for each scene and regime."""
    panels: dict[str, list[plots.Point]] = {}
    for (scene, regime), mine in in_scenes([row for row in rows if row["trained"]]):
        panels[f"{scene}, {regime}"] = [
            plots.Point(str(r["method"]), float(r[ERROR]), float(r[cost]), _note(r)) for r in mine if known(r[cost])
        ]
    return plots.error_against_time(panels, "displacement RRMSE", label)


def _note(row: Mapping[str, Any]) -> str:
    """What stands beside a point of the front."""
    parts = [str(row["method"])]
    if row["backend"] != "eager":
        parts.append(str(row["backend"]))
    if row["resolution"] != 1.0:
        parts.append(f"{1e3 * row['pitch_m']:.3g}mm")
    return " ".join(parts)


def growth_plot(rows: Rows) -> bytes:
    """Milliseconds per frame against nodes, a panel a scene, with the fitted exponent in the legend."""
    scenes = list(dict.fromkeys(str(row["scene"]) for row in rows))
    figure = Figure(figsize=(6.6 * max(len(scenes), 1), 5.0), layout="constrained")
    axes = figure.subplots(1, max(len(scenes), 1), squeeze=False)[0]
    for axis, scene in zip(axes, scenes, strict=False):
        methods = dict.fromkeys(str(row["method"]) for row in rows if row["scene"] == scene)
        for method in methods:
            mine = [row for row in rows if (row["scene"], row["method"]) == (scene, method)]
            nodes, ms = (np.array([row[name] for row in mine], float) for name in ("nodes", "ms_p50"))
            law = fit_growth(nodes, ms)
            colour, marker = plots.style_of(method.split(",")[0])
            style = "--" if "finer" in method else ":" if "kernel" in method else "-"
            axis.plot(nodes, ms, style, color=colour, marker=marker, label=f"{method}: n^{law.exponent:.2f}")
        axis.set(xscale="log", yscale="log", title=scene, xlabel="nodes", ylabel="milliseconds per frame")
        axis.axhline(1000 / 30, color="#999999", lw=1)
        axis.annotate("30 Hz", (0.01, 1000 / 30), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)
        axis.grid(alpha=0.3)
        axis.legend(frameon=False, fontsize=8)
    return plots.png_of(figure)
