"""Tables and pictures of the sim-to-real evaluation of the glass twin.

`evaluate_glass_clips` writes `clips.csv` (a row per clip and case), `summary.csv` and `summary.md` (mean and worst over
the clips, and how much better the closed loop is), `latency.csv` (parts of a frame), `errors.png`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from tqdm import tqdm

from zsdt.evaluation import twin_tables
from zsdt.evaluation.glass_twin_cases import HIGH, GlassCase, GlassTwinEvaluationOptions, judge_glass_clip
from zsdt.evaluation.plots import SETTINGS, png_of
from zsdt.files import atomic_path
from zsdt.lab.glass_clips import GlassClipSet
from zsdt.shipped import TwinWeights
from zsdt.twin.glass_errors import QUIET
from zsdt.twin.glass_log import GLASS_PARTS
from zsdt.workers import plain, run_all

# Columns of the summary: name in the rows, head, factor.
FIGURES = (
    ("level_mm", "level mm", 1.0),
    ("level_px", "level px", 1.0),
    ("level_share", "level % of fill", 100.0),
    ("level_worst_share", "worst frame % of fill", 100.0),
    ("centroid_mm", "centroid mm", 1.0),
    ("vertical_velocity_rrmse", "vertical velocity %", 100.0),
    ("vertical_velocity_floor", "of that its floor %", 100.0),
    ("vertical_velocity_mean_rrmse", "by near means %", 100.0),
    ("frequency_error", "frequency off %", 100.0),
    ("lag_ms", "late by ms", 1.0),
    ("rest_ratio", "rest / true rest", 1.0),
    ("rest_frame", "rest at frame", 1.0),
    ("true_rest_frame", "true rest at frame", 1.0),
    ("volume_error", "volume off %", 100.0),
    ("volume_drift", "volume drift %", 100.0),
    ("innovation_mm", "innovation mm", 1.0),
    ("t0_error_frames", "t0 off frames", 1.0),
)
PAIRS = {
    "the seed's open loop (Psi_ini) over the closed loop": (GlassCase.seed_open, GlassCase.closed),
    "the open loop (carried from rest) over the closed loop": (GlassCase.open, GlassCase.closed),
    "the seed's open loop over its closed loop, column by column": (GlassCase.seed_open, GlassCase.columns),
    "the lab's own masks: the seed's open loop over the closed loop": (GlassCase.masks_seed_open, GlassCase.masks),
    "the lab's own masks: the open loop over the closed loop": (GlassCase.masks_open, GlassCase.masks),
    "the lab's own masks: the seed's open over its closed loop": (GlassCase.masks_seed_open, GlassCase.masks_columns),
    "told the true viscosity and camera": (GlassCase.told_open, GlassCase.told),
}
CASES = {
    GlassCase.seed_open: "the seed's open loop: Psi_ini tells the velocity at t0, nothing is corrected",
    GlassCase.open: "open loop whose liquid is carried from its rest along the vessel's seen motion",
    GlassCase.closed: "the same, corrected by the seen surface",
    GlassCase.columns: "the seed's closed loop: Psi_ini, and columns stretched to the seen height",
    GlassCase.masks_seed_open: "as `seed_open`, with the lab's own masks: what is left is not segmentation's",
    GlassCase.masks_open: "as `open`, with the lab's own masks",
    GlassCase.masks: "as `closed`, with the lab's own masks",
    GlassCase.masks_columns: "as `columns`, with the lab's own masks",
    GlassCase.masks_high: f"as `masks`, but the liquid's masks end {HIGH} px too high",
    GlassCase.told_open: "as `open`, told the true viscosity and camera",
    GlassCase.told: "as `closed`, told the true viscosity and camera",
    GlassCase.dropped: "closed, a tenth of the frames never comes",
    GlassCase.dark: "closed, a tenth of the frames is dark",
    GlassCase.frozen: "closed, a tenth of the frames repeats the one before",
    GlassCase.blurred: "closed, a tenth of the frames is blurred",
    GlassCase.hand: "closed, a sleeve hides two thirds of the glass for a quarter of a second",
    GlassCase.leaving: "closed, the camera turns until the glass has left the picture, and back",
}
GAINS = {"vertical_velocity_rrmse": "vertical velocity", "level_mm": "level"}
LOOP_PARTS = (*(part for part in GLASS_PARTS if part != "capture"), "total")
STYLES: dict[str, dict[str, Any]] = {
    GlassCase.seed_open: {"color": "#A05010", "ls": ":"},
    GlassCase.open: {"color": "#D55E00", "ls": "--"},
    GlassCase.closed: {"color": "#009E73", "ls": "-"},
    GlassCase.columns: {"color": "#E69F00", "ls": "-."},
    GlassCase.masks_seed_open: {"color": "#666666", "ls": ":"},
    GlassCase.masks_open: {"color": "#999999", "ls": "--"},
    GlassCase.masks: {"color": "#0072B2", "ls": "-"},
    GlassCase.told_open: {"color": "#CC79A7", "ls": "--"},
    GlassCase.told: {"color": "#56B4E9", "ls": "-"},
}


def evaluate_glass_clips(
    clips: str | Path,
    weights: TwinWeights,
    options: GlassTwinEvaluationOptions,
    out: str | Path,
    scratch: str | Path | None = None,
    workers: int = 1,
    command: str = "",
) -> dict[str, Any]:
    """Runs every case on every clip and writes the tables; returns the figures of the summary.

    Rows are kept in `scratch`, where an interrupted evaluation goes on. Raises: DataError where there are no clips.
    """
    out, found = Path(out), GlassClipSet(clips)
    kept = None if scratch is None else Path(scratch) / "rows"
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
    jobs = {
        f"{entry['name']} {case.value}": (str(found.folder / entry["name"]), case.value, weights, options)
        for entry in found.entries
        for case in options.cases
    }
    done = {} if kept is None else {name: _kept(kept, name) for name in jobs if _file(kept, name).is_file()}
    results: dict[str, dict[str, Any]] = dict(done)
    todo = {name: (_file(kept, name) if kept else None, *job) for name, job in jobs.items() if name not in done}
    with tqdm(total=len(jobs), initial=len(done), desc="glass twin", unit="run", disable=None) as bar:
        run_all(judge_and_keep, todo, workers, results, bar)
    rows = [results[name] for name in jobs]
    table = pd.DataFrame([{k: v for k, v in row.items() if k != "curves"} for row in rows])
    summary = summarise(table)
    for name, frame in (("clips", table), ("summary", summary), ("latency", latency(table))):
        with atomic_path(out / f"{name}.csv") as beside:
            frame.to_csv(beside, index=False)
    with atomic_path(out / "summary.md") as beside:
        beside.write_text(page(table, summary, command))
    with atomic_path(out / "errors.png") as beside:
        beside.write_bytes(picture(rows, 1.0 / float(next(iter(found.entries))["fps"])))
    return figures_of(table, summary)


def judge_and_keep(
    file: Path | None, folder: str, case: str, weights: TwinWeights, options: GlassTwinEvaluationOptions
) -> dict[str, Any]:
    """The row of `judge_glass_clip`, kept as JSON in `file`."""
    row = plain(judge_glass_clip(folder, case, weights, options))
    if file is not None:
        with atomic_path(file) as beside:
            beside.write_text(json.dumps(row))
    return row


def _file(kept: Path, name: str) -> Path:
    return kept / f"{name.replace(' ', '.')}.json"


def _kept(kept: Path, name: str) -> dict[str, Any]:
    return json.loads(_file(kept, name).read_text())


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Mean and worst of each figure over the clips, a row per case and family."""
    return twin_tables.summary_of(table, FIGURES, "family")


def latency(table: pd.DataFrame) -> pd.DataFrame:
    """Milliseconds of each part of the closed loop."""
    return twin_tables.latency_of(table, GlassCase.closed.value, LOOP_PARTS)


def gains(table: pd.DataFrame) -> dict[str, dict[str, float]]:
    """How many times smaller the errors of the closed loop are: ratio of the means, and of the clip gaining least."""
    found: dict[str, dict[str, float]] = {}
    for name, (open_case, closed_case) in PAIRS.items():
        sides = [table[table["case"] == case.value].set_index("clip") for case in (open_case, closed_case)]
        if any(side.empty or "level_mm" not in side for side in sides):
            continue
        found[name] = {}
        for figure in GAINS:
            one, other = (side[figure].astype(float) for side in sides)
            found[name] |= {f"{figure}_gain": one.mean() / other.mean(), f"{figure}_gain_least": (one / other).min()}
    return found


def figures_of(table: pd.DataFrame, summary: pd.DataFrame) -> dict[str, Any]:
    """What the table of a sweep shows."""
    found = twin_tables.figures_of(table, summary, FIGURES, "family", gains(table), latency(table))
    return {"scene": "glass", **found}


def page(table: pd.DataFrame, summary: pd.DataFrame, command: str) -> str:
    """The summary as Markdown."""
    lines = ["# Glass twin, virtual lab", "", *([f"`{command}`", ""] if command else [])]
    lines += [
        f"{table['clip'].nunique()} clips of liquids in vessels that no network has met, of a viscosity that is up to "
        "a fifth from the told one, simulated with other particles; mean over the clips (worst). The open loops "
        "predict from t0 on. Level: of the surface's profile, root mean square over columns and frames. Vertical "
        "velocity: at the lab's particles, over the truth; between the twin's particles it is a spline through them. "
        "Its floor is what the truth itself scores on the twin's particles; by near means: with a mean over two "
        "spacings instead of the spline, the measure of reports before this column. Rest: when the vertical velocity "
        f"has died down to {100 * QUIET:.0f} % of the greatest, in frames after t0.",
        "",
        *(f"- `{case}`: {words}" for case, words in CASES.items() if (table["case"] == case).any()),
        "",
    ]
    lines += twin_tables.table_lines(summary, FIGURES, "family")
    lines += ["", "Open loop over closed loop (of the means; of the clip that gains least):", ""]
    for name, found in gains(table).items():
        words = [f"{GAINS[g]} {found[f'{g}_gain']:.1f} ({found[f'{g}_gain_least']:.1f})" for g in GAINS]
        lines.append(f"- {name}: {', '.join(words)}")
    lines += ["", "Milliseconds of a frame of the closed loop, mean over the clips (without reading the video):", ""]
    lines += twin_tables.latency_lines(latency(table))
    counts = table["particles"].dropna() if "particles" in table else pd.Series(dtype=float)
    if len(counts):
        lines += ["", f"{counts.min():.0f} to {counts.max():.0f} particles; one thread."]
    lines += ["", *twin_tables.failed_lines(table)]
    return "\n".join(lines).rstrip() + "\n"


PANELS = {
    "level_mm": "level of the surface, root mean square error [mm]",
    "vertical_velocity": "vertical velocity, error / largest of the truth [%]",
    "rise": "vertical velocity, root mean square [mm/s]",
}


def picture(rows: Sequence[Mapping[str, Any]], frame_dt: float) -> bytes:
    """Errors and motion over the time after t0: median over the clips and their range, a colour per case."""
    with mpl.rc_context({**SETTINGS, "axes.titlesize": 10}):
        figure = Figure(figsize=(13.0, 4.2), layout="constrained")
        for axis, (name, title) in zip(figure.subplots(1, len(PANELS)), PANELS.items(), strict=True):
            factor = {"level_mm": 1.0, "vertical_velocity": 100.0, "rise": 1e3}[name]
            for case, style in STYLES.items():
                curves = [row["curves"][name] for row in rows if row["case"] == case and row["curves"]]
                _band(axis, curves, factor, frame_dt, str(case), style)
            if name == "rise":
                truth = [
                    row["curves"]["true_rise"] for row in rows if row["case"] == GlassCase.closed and row["curves"]
                ]
                _band(axis, truth, factor, frame_dt, "truth", {"color": "#000000", "ls": "-", "lw": 1.0})
            axis.set(title=title, xlabel="time after t0 [s]")
            _room_for(axis)
            if axis.lines:
                axis.legend(frameon=False, fontsize=8)
        figure.suptitle("Median over the clips of the virtual lab, and the middle half of them", fontsize=11)
        return png_of(figure)


def _band(axis, curves: list[list[float]], factor: float, frame_dt: float, name: str, style: dict[str, Any]) -> None:
    if not curves:
        return
    length = min(map(len, curves))
    stack = factor * np.array([curve[:length] for curve in curves])
    times = frame_dt * np.arange(length)
    axis.plot(times, np.median(stack, axis=0), label=name, **style)
    # The worst clips stand in the table: one that diverges would leave nothing else to be seen here.
    low, high = np.percentile(stack, [25, 75], axis=0)
    axis.fill_between(times, low, high, color=style["color"], alpha=0.1, lw=0)


def _room_for(axis) -> None:
    """From zero to half as much again as the highest median, below which bands may be cut."""
    highest = max((float(np.nanmax(line.get_ydata())) for line in axis.lines), default=0.0)
    axis.set_ylim(0.0, 1.5 * highest if highest > 0 else None)
