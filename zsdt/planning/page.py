"""Plans against measurement as a page: a table (CSV and Markdown) and a picture with a panel for each pair."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from zsdt.evaluation.plots import SETTINGS, png_of
from zsdt.files import atomic_path
from zsdt.planning.planner import percent, short
from zsdt.planning.validation import TOLERANCE, Judged, asked

COLUMNS = 4  # panels in a row
INTRODUCTION = """A scene and a budget go to the planner, which knows the measured data of the package and nothing of
the clip; every choice is then measured on that clip. *Best* is the cheapest that meets the budget, or, where only a
time is given, the least error within it. A plan is good when it is within {tolerance:.0f} % of the best and of the
budget; a refusal is good when no choice meets the budget. Errors are RRMSE of the wanted fields over all nodes, hidden
ones included, of the twin in closed loop in front of the virtual lab (of a glass: vertical velocity, and height of the
surface over the fill); milliseconds of a frame on one thread, on average over frames with and without a look."""


def write_page(docs: Path, judged: Sequence[Judged], notes: Sequence[str], command: str, commit: str) -> Path:
    """Writes plan.csv, plan.md and plan.png into `docs`; returns the page. notes: lines about the data."""
    rows = [row_of(one) for one in judged]
    with atomic_path(docs / "plan.csv") as beside:
        beside.write_text(f"# Made by `{command}` at commit {commit}.\n{pd.DataFrame(rows).to_csv(index=False)}")
    with atomic_path(docs / "plan.png") as beside:
        beside.write_bytes(picture(judged))
    page = docs / "plan.md"
    with atomic_path(page) as beside:
        beside.write_text(markdown(judged, notes, command, commit))
    return page


def row_of(one: Judged) -> dict[str, Any]:
    """A pair as a line of the CSV: errors as fractions, times in milliseconds."""
    pair = one.pair
    return {
        "scene": one.scene, "fields": " ".join(pair.fields), "budget_error": pair.error, "budget_ms": pair.frame_ms,
        "planar": pair.planar if pair.kind == "beam" else None, "refused": one.refused, "choice": one.choice,
        "expected_ms": one.expected_ms, "expected_error": one.expected_error, "ms": one.frame_ms, "error": one.error,
        "best": one.best, "best_ms": one.best_ms, "best_error": one.best_error, "good": one.good, "words": one.words,
    }  # fmt: skip


def markdown(judged: Sequence[Judged], notes: Sequence[str], command: str, commit: str) -> str:
    """The page."""
    met = [one for one in judged if not one.refused]
    refused = [one for one in judged if one.refused]
    introduction = INTRODUCTION.format(tolerance=100 * TOLERANCE)
    lines = [
        "# plan", "", f"Made by `{command}` at commit {commit}.", "", introduction, "",
        f"**{sum(one.good for one in met)} of {len(met)} plans are good; {sum(one.good for one in refused)} of "
        f"{len(refused)} refusals are right.**", "", *notes, "",
        "| scene | budget | plan | expected | measured | best | best measured | good |",
        "|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for one in judged:
        plan = "refused" if one.refused else one.choice
        cells = [
            one.scene, asked(one.pair), plan, _both(one.expected_ms, one.expected_error),
            _both(one.frame_ms, one.error), one.best or "none", _both(one.best_ms, one.best_error),
            "yes" if one.good else "**no**",
        ]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    lines += ["", "What the planner says:", "", *(f"- {one.scene}, {asked(one.pair)}: {one.words}" for one in judged)]
    return "\n".join([*lines, "", "![Error against time of all choices, the plan and the best](plan.png)", ""])


def _both(milliseconds: float, error: float) -> str:
    return "-" if math.isnan(milliseconds) else f"{short(milliseconds)} ms, {percent(error)}"


def picture(judged: Sequence[Judged]) -> bytes:
    """A panel for each pair: all choices, the budget as a shaded corner, the plan and the best."""
    count = math.ceil(len(judged) / COLUMNS)
    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(4.0 * COLUMNS, 3.4 * count), layout="constrained")
        axes = figure.subplots(count, COLUMNS, squeeze=False).ravel()
    for axis, one in zip(axes, judged, strict=False):
        _panel(axis, one)
    for axis in axes[len(judged) :]:
        axis.set_axis_off()
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    return png_of(figure)


def _panel(axis: Axes, one: Judged) -> None:
    milliseconds, errors = [p[1] for p in one.points], [100 * p[2] for p in one.points]
    axis.scatter(milliseconds, errors, s=26, color="#999999", label="every choice, measured")
    axis.set(xscale="log", yscale="log", xlabel="ms per frame", ylabel=f"error of {' and '.join(one.pair.fields)} %")
    low, high = 0.7 * min(milliseconds), 1.4 * max(milliseconds)
    bottom, top = 0.7 * min(errors), 1.4 * max(errors)
    if one.pair.error is not None:
        bottom = min(bottom, 70 * one.pair.error)
    if one.pair.frame_ms is not None:
        low = min(low, 0.7 * one.pair.frame_ms)
    axis.set(xlim=(low, high), ylim=(bottom, top))
    for one_axis in (axis.xaxis, axis.yaxis):
        one_axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        one_axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        one_axis.set_minor_formatter(NullFormatter())
    right = min(one.pair.frame_ms or high, high)
    roof = min(100 * (one.pair.error or math.inf), top)
    axis.fill_between([low, right], bottom, roof, color="#009E73", alpha=0.12, lw=0, label="within the budget")
    if one.best:
        axis.scatter([one.best_ms], [100 * one.best_error], s=150, facecolors="none", edgecolors="#000000", lw=1.4,
                     label="the best")  # fmt: skip
    if not one.refused:
        axis.scatter([one.frame_ms], [100 * one.error], s=60, color="#0072B2", marker="D", label="the plan")
        axis.scatter([one.expected_ms], [100 * one.expected_error], s=60, color="#0072B2", marker="x",
                     label="what it expected")  # fmt: skip
    verdict = "refused" if one.refused else "good" if one.good else "missed"
    axis.set_title(f"{one.scene}\n{asked(one.pair)}: {verdict}", fontsize=9)
