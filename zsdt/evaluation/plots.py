"""Plots of a report: error against time, error against swept factors, error over a rollout.

Colours are those of Okabe and Ito, which people with any kind of colour vision can tell apart; each kind of method
has a marker of its own as well. Every function returns a PNG as bytes.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from zsdt.evaluation.pareto import pareto_front

# Name of a method (its first part) -> colour and marker.
STYLES: dict[str, tuple[str, str]] = {
    "tignn_cell": ("#009E73", "D"),
    "tignn_particle": ("#009E73", "D"),
    "tignn_exact": ("#0072B2", "o"),
    "seed_form": ("#0072B2", "p"),
    "tignn_soft": ("#56B4E9", "s"),
    "seed_literal": ("#882255", "H"),
    "black_box": ("#D55E00", "X"),
    "fem_5cm": ("#000000", "^"),
    "full_sph": ("#000000", "d"),
    "coarse_sph": ("#000000", "^"),
    "coarser_sph": ("#777777", "v"),
    "fem_10cm": ("#777777", "v"),
    "inertia": ("#E69F00", "<"),
    "static": ("#CC79A7", "P"),
    "open loop": ("#D55E00", "o"),  # of a twin
    "closed loop": ("#0072B2", "s"),
}
FROM_PSI_INI = "_from_psi_ini"
NOTHING_MOVES = "static"
OTHER = ("#F0E442", "h")
SETTINGS: Any = {
    "font.size": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


@dataclass(frozen=True)
class Point:
    """One method on one kind of trajectories: error as a fraction, milliseconds per frame, and a note beside it."""

    method: str
    error: float
    milliseconds: float
    note: str = ""


@dataclass(frozen=True)
class Curve:
    """Error of one method over a rollout: times [s] and errors as fractions, with the spread over trajectories."""

    method: str
    label: str
    times: Float[np.ndarray, " frames"]
    middle: Float[np.ndarray, " frames"]
    low: Float[np.ndarray, " frames"]
    high: Float[np.ndarray, " frames"]


def style_of(method: str) -> tuple[str, str]:
    """Colour and marker of a method by its name; one that starts from Psi_ini has the colour of its engine."""
    if method.endswith(FROM_PSI_INI):
        return STYLES.get(method.removesuffix(FROM_PSI_INI), OTHER)[0], "*"
    return STYLES.get(method, OTHER)


def error_against_time(
    panels: Mapping[str, Sequence[Point]], quantity: str, cost: str = "milliseconds per frame"
) -> bytes:
    """Error [%] against milliseconds per frame (or another `cost`), a panel for each kind of trajectories; the Pareto
    front is a line.

    The picture in which nothing moves costs nothing, so it is a level and not a point.
    """
    figure, axes = _figure(len(panels), 5.2, 4.2)
    for axis, (title, points) in zip(axes, panels.items(), strict=True):
        known = [p for p in points if math.isfinite(p.error) and math.isfinite(p.milliseconds) and p.error > 0]
        shown = [p for p in known if p.method != NOTHING_MOVES]
        for level in {p.error for p in known if p.method == NOTHING_MOVES}:
            axis.axhline(100 * level, color=style_of(NOTHING_MOVES)[0], ls="--", lw=1.4, zorder=0)
        costs = np.array([[p.milliseconds, p.error] for p in shown]).reshape(-1, 2)
        front = pareto_front(costs)
        order = np.flatnonzero(front)[np.argsort(costs[front, 0])]
        axis.step(costs[order, 0], 100 * costs[order, 1], where="post", color="#999999", lw=1.5, zorder=1)
        for point, on_front in zip(shown, front, strict=True):
            colour, marker = style_of(point.method)
            edge: dict[str, Any] = (
                {"edgecolor": "black", "linewidth": 1.4} if on_front else {"edgecolor": "white", "linewidth": 0.6}
            )
            size = 110 if on_front else 55
            axis.scatter(point.milliseconds, 100 * point.error, s=size, c=colour, marker=marker, zorder=3, **edge)
        _name_points(axis, shown, front)
        axis.set(xscale="log", yscale="log", title=title, xlabel=cost, ylabel=f"{quantity} [%]")
        axis.margins(0.15)
        _plain_ticks(axis)
    _legend(figure, [p.method for points in panels.values() for p in points], front=True)
    return png_of(figure)


def _name_points(axis: Axes, points: Sequence[Point], front: Sequence[bool] | np.ndarray) -> None:
    """Notes beside the points of the front, a line for each word after the method's name."""
    if not points:
        return
    middle = math.sqrt(min(p.milliseconds for p in points) * max(p.milliseconds for p in points))
    for point, on_front in zip(points, front, strict=True):
        if on_front and point.note:
            right = point.milliseconds > middle
            axis.annotate(
                "\n".join(point.note.split()),
                (point.milliseconds, 100 * point.error),
                xytext=(-9 if right else 9, 0),
                textcoords="offset points",
                ha="right" if right else "left",
                va="center",
                fontsize=7.5,
                linespacing=1.0,
                zorder=4,
                in_layout=False,
                bbox={"facecolor": "white", "alpha": 0.75, "pad": 1, "linewidth": 0},
            )


def error_against_factors(rows: Sequence[Mapping[str, Any]], factors: Sequence[str], quantity: str) -> bytes:
    """Error [%] against each swept factor: each job a dot, lines join jobs that differ in nothing else; the mean of
    each method is a thick line.

    rows: one per job with the factors (numbers or words), ``error`` (fraction) and ``method``.
    """
    figure, axes = _figure(len(factors), 3.8, 3.6, share=True)
    for axis, factor in zip(axes, factors, strict=True):
        levels = sorted({row[factor] for row in rows}, key=lambda value: (isinstance(value, str), value))
        place = {level: k for k, level in enumerate(levels)}
        others = [name for name in factors if name != factor]
        groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
        for row in rows:
            groups.setdefault((row["method"], *(row[name] for name in others)), []).append(row)
        for (method, *_), members in groups.items():
            members = sorted(members, key=lambda row: place[row[factor]])
            colour, marker = style_of(method)
            x, y = [place[row[factor]] for row in members], [100 * row["error"] for row in members]
            axis.plot(x, y, color=colour, marker=marker, alpha=0.55, lw=1, markeredgecolor="white")
        methods = dict.fromkeys(row["method"] for row in rows)
        for method in methods:
            mine = [[row["error"] for row in rows if row[factor] == v and row["method"] == method] for v in levels]
            means = [100 * float(np.mean(errors)) if errors else math.nan for errors in mine]
            colour, words = ("black", "mean") if len(methods) == 1 else (style_of(method)[0], f"{method}, mean")
            style: dict[str, Any] = {"lw": 2.5, "marker": "_", "ms": 16, "mew": 2.5, "zorder": 4}
            axis.plot(range(len(levels)), means, color=colour, label=words, **style)
        axis.set_xticks(range(len(levels)), [f"{v:g}" if isinstance(v, int | float) else str(v) for v in levels])
        axis.set(xlabel=factor.rpartition(".")[2], xlim=(-0.4, len(levels) - 0.6))
    axes[0].set_ylabel(f"{quantity} [%]")
    axes[-1].legend(frameon=False, loc="best")
    return png_of(figure)


def error_over_time(panels: Mapping[str, Sequence[Curve]], quantity: str) -> bytes:
    """Error [%] over the rollout, a panel for each kind of trajectories: median and the band of the middle half."""
    figure, axes = _figure(len(panels), 5.2, 3.8)
    for axis, (title, curves) in zip(axes, panels.items(), strict=True):
        for curve in curves:
            colour, marker = style_of(curve.method)
            every = max(len(curve.times) // 8, 1)
            shown: dict[str, Any] = {"color": colour, "marker": marker, "markevery": every, "ms": 5, "lw": 1.6}
            axis.plot(curve.times, 100 * curve.middle, label=curve.label, **shown)
            axis.fill_between(curve.times, 100 * curve.low, 100 * curve.high, color=colour, alpha=0.12, lw=0)
        axis.set(title=title, xlabel="time [s]", ylabel=f"{quantity} [%]", yscale="log")
        _plain_ticks(axis)
    labels = {c.label: c.method for curves in panels.values() for c in curves}
    _legend(figure, list(labels.values()), labels=list(labels), lines=True)
    return png_of(figure)


def bars(values: Mapping[str, float], quantity: str, log: bool = False) -> bytes:
    """One bar for each named value, longest names readable."""
    figure = Figure(figsize=(7.0, 0.36 * len(values) + 1.0), layout="constrained")
    axis = figure.subplots()
    names = list(values)[::-1]
    axis.barh(names, [values[name] for name in names], color=[style_of(n.split()[0])[0] for n in names], height=0.65)
    for place, name in enumerate(names):
        axis.text(values[name], place, f" {values[name]:.3g}", va="center", fontsize=9)
    axis.set(xlabel=quantity, xscale="log" if log else "linear")
    axis.grid(axis="y", visible=False)
    axis.margins(x=0.12)
    return png_of(figure)


def _figure(panels: int, width: float, height: float, share: bool = False) -> tuple[Figure, list[Axes]]:
    import matplotlib

    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(width * panels, height + 0.7), layout="constrained")
        axes = figure.subplots(1, panels, squeeze=False, sharey=share)
    return figure, list(axes[0])


def _plain_ticks(axis: Axes) -> None:
    """Numbers on logarithmic axes as people write them; between powers of ten only 2 and 5."""

    def major(value: float, _: object) -> str:
        return f"{value:g}"

    def minor(value: float, _: object) -> str:
        return f"{value:g}" if round(value / 10 ** math.floor(math.log10(value) + 1e-9)) in (2, 5) else ""

    for one in (axis.xaxis, axis.yaxis):
        if one.get_scale() == "log":
            one.set_major_formatter(FuncFormatter(major))
            low, high = one.get_view_interval()
            one.set_minor_formatter(FuncFormatter(minor) if high / max(low, 1e-300) < 200 else NullFormatter())
            one.set_tick_params(which="minor", labelsize=8)


def _legend(
    figure: Figure,
    methods: Sequence[str],
    labels: Sequence[str] | None = None,
    lines: bool = False,
    front: bool = False,
) -> None:
    from matplotlib.lines import Line2D

    named = dict(zip(labels or methods, methods, strict=True))
    handles = [
        Line2D([], [], color=colour, marker=marker, ls="-" if lines else "", ms=8, label=label)
        if lines or label != NOTHING_MOVES
        else Line2D([], [], color=colour, ls="--", label=f"{NOTHING_MOVES} (nothing moves)")
        for label, (colour, marker) in ((label, style_of(method)) for label, method in named.items())
    ]
    if front:
        handles.append(Line2D([], [], color="#999999", lw=1.5, label="Pareto front"))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(len(handles), max(2, round(figure.get_figwidth() / 2.1))),
        frameon=False,
    )


def png_of(figure: Figure) -> bytes:
    """A figure as PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=130)
    return file.getvalue()
