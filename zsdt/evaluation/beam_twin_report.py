"""Tables and pictures of the sim-to-real evaluation of the beam twin.

`evaluate_clips` writes `clips.csv` (a row per clip and case), `summary.csv` and `summary.md` (mean and worst over the
clips, and how much better the closed loop is), `latency.csv` (parts of a frame), `errors.png`.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from tqdm import tqdm

from zsdt.evaluation import twin_tables
from zsdt.evaluation.beam_twin_cases import Case, TwinEvaluationOptions, judge_clip
from zsdt.files import atomic_path
from zsdt.lab.clips import ClipSet
from zsdt.shipped import TwinWeights
from zsdt.twin.twin_log import PARTS
from zsdt.workers import run_all

# Columns of the summary: name in the rows, head, factor, digits.
FIGURES = (
    ("displacement_rrmse", "displacement %", 100.0),
    ("position_rmse", "position mm", 1000.0),
    ("velocity_rrmse", "velocity %", 100.0),
    ("stress_rrmse", "stress %", 100.0),
    ("clamp_von_mises_rrmse", "von Mises at the clamp %", 100.0),
    ("drift_mm_per_s", "drift mm/s", 1.0),
    ("innovation_mm", "innovation mm", 1.0),
)
PAIRS = {
    "told material": (Case.open, Case.closed),
    "told material, engine's own rest": (Case.open, Case.own_rest),
    "E 20 % off": (Case.open_wrong, Case.closed_wrong),
    "E 20 % off, engine's own rest": (Case.open_wrong, Case.own_rest_wrong),
}
LOOP_PARTS = (*(part for part in PARTS if part != "capture"), "total")


def evaluate_clips(
    clips: str | Path,
    weights: TwinWeights,
    options: TwinEvaluationOptions,
    out: str | Path,
    workers: int = 1,
    command: str = "",
) -> dict[str, Any]:
    """Runs every case on every clip and writes the tables; returns the figures of the summary.

    Raises: DataError where there are no clips, or a picture shows no grid.
    """
    out, found = Path(out), ClipSet(clips)
    jobs = {
        f"{entry['name']} {case.value}": (str(found.folder / entry["name"]), case.value, weights, options)
        for entry in found.entries
        for case in options.cases
    }
    results: dict[str, dict[str, Any]] = {}
    with tqdm(total=len(jobs), desc="twin", unit="run", disable=None) as bar:
        run_all(judge_clip, jobs, workers, results, bar)
    rows = [results[name] for name in jobs]
    table = pd.DataFrame([{k: v for k, v in row.items() if k != "curve"} for row in rows])
    summary = summarise(table)
    for name, frame in (("clips", table), ("summary", summary), ("latency", latency(table))):
        with atomic_path(out / f"{name}.csv") as beside:
            frame.to_csv(beside, index=False)
    with atomic_path(out / "summary.md") as beside:
        beside.write_text(page(table, summary, command))
    with atomic_path(out / "errors.png") as beside:
        beside.write_bytes(picture(rows))
    return figures_of(table, summary)


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Mean and worst of each figure over the clips, a row per case and regime."""
    return twin_tables.summary_of(table, FIGURES, "regime")


def latency(table: pd.DataFrame) -> pd.DataFrame:
    """Milliseconds of each part of the closed loop."""
    return twin_tables.latency_of(table, Case.closed.value, LOOP_PARTS)


def gains(table: pd.DataFrame) -> dict[str, dict[str, float]]:
    """How many times smaller the errors of the closed loop are: ratio of the means, and of the clip gaining least."""
    found: dict[str, dict[str, float]] = {}
    for name, (open_case, closed_case) in PAIRS.items():
        sides = [table[table["case"] == case.value].set_index("clip") for case in (open_case, closed_case)]
        if any(side.empty for side in sides):
            continue
        found[name] = {}
        for figure in ("position_rmse", "stress_rrmse"):
            ratio = sides[0][figure].astype(float) / sides[1][figure].astype(float)
            of_means = sides[0][figure].astype(float).mean() / sides[1][figure].astype(float).mean()
            key = figure.split("_")[0]
            found[name] |= {f"{key}_gain": of_means, f"{key}_gain_least": ratio.min()}
    return found


def figures_of(table: pd.DataFrame, summary: pd.DataFrame) -> dict[str, Any]:
    """What the table of a sweep shows."""
    return twin_tables.figures_of(table, summary, FIGURES, "regime", gains(table), latency(table))


def page(table: pd.DataFrame, summary: pd.DataFrame, command: str) -> str:
    """The summary as Markdown."""
    lines = ["# Beam twin, virtual lab", "", f"`{command}`" if command else "", ""]
    lines += [
        f"{table['clip'].nunique()} clips of beams that no network has met, of a material that is not the told one, "
        "under loads that nobody tells. All",
        "free nodes, hidden ones included; RRMSE as in DESIGN 6, mean over the clips (worst). The open loop predicts "
        "from the first frame on.",
        "",
    ]
    lines += twin_tables.table_lines(summary, FIGURES, "regime")
    lines += ["", "Open loop over closed loop (of the means; of the clip that gains least):", ""]
    for name, found in gains(table).items():
        lines.append(
            f"- {name}: position {found['position_gain']:.1f} ({found['position_gain_least']:.1f}), "
            f"stress {found['stress_gain']:.1f} ({found['stress_gain_least']:.1f})"
        )
    lines += ["", "Milliseconds of a frame of the closed loop, mean over the clips (without reading the video):", ""]
    lines += twin_tables.latency_lines(latency(table))
    nodes = table["nodes"].dropna() if "nodes" in table else pd.Series(dtype=float)
    if len(nodes):
        lines += ["", f"{nodes.min():.0f} to {nodes.max():.0f} nodes; one thread."]
    lines += ["", *twin_tables.failed_lines(table)]
    return "\n".join(lines).rstrip() + "\n"


def picture(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Position error over the frames: median and range over the clips, a colour per case."""
    figure, axis = plt.subplots(figsize=(8, 4.5))
    colours = plt.get_cmap("tab10")
    cases = dict.fromkeys(row["case"] for row in rows if row["case"] != Case.long)
    for k, case in enumerate(cases):
        curves = [row["curve"] for row in rows if row["case"] == case and row["curve"]]
        if not curves:
            continue
        length = min(map(len, curves))
        stack = 1e3 * np.array([curve[:length] for curve in curves])
        axis.plot(np.median(stack, axis=0), color=colours(k), label=case)
        axis.fill_between(range(length), stack.min(axis=0), stack.max(axis=0), color=colours(k), alpha=0.08, lw=0)
    axis.set(yscale="log", xlabel="frame", ylabel="position error, RMS over nodes [mm]")
    axis.set_title("Median over the clips of the virtual lab, and their range", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(ncols=2, fontsize=8)
    content = io.BytesIO()
    figure.savefig(content, dpi=130, bbox_inches="tight", format="png")
    plt.close(figure)
    return content.getvalue()
