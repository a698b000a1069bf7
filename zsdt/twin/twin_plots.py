"""One figure that sums up a run of a twin: errors against the truth, innovation, where the time goes.

Colours are those of Okabe and Ito; each side has a line style of its own as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from zsdt.evaluation.plots import SETTINGS, png_of
from zsdt.twin.twin_errors import ERROR_NAMES, distances, relative_errors
from zsdt.twin.twin_view import TwinView

_CLOSED: dict[str, Any] = {"color": "#009E73", "ls": "-"}
_OPEN: dict[str, Any] = {"color": "#D55E00", "ls": "--"}
_PARTS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#777777")
_FAULT = "#CC79A7"
_SUM = "all but waiting"
_PARTLY = 0.9  # share of seen nodes below which a frame counts as partly hidden
SEED_MILLISECONDS = 9.1  # of one frame in the seed, on a GPU
_LEAST = 1e-3  # mm: what is nearer counts as this on a logarithmic axis
SHOWN_ERRORS = ("stress", "von_mises")


def run_summary(view: TwinView, truth: TwinView | None = None, open_loop: TwinView | None = None) -> bytes:
    """PNG with a panel for position error, stress error (both only with a truth), innovation and latency.

    open_loop: the same clip without correction. Raises: DataError where truth and run are not on the same grid.
    """
    sides = [(view, _CLOSED if view.closed else _OPEN)]
    if open_loop is not None:
        sides.append((open_loop, _OPEN))
    with mpl.rc_context({**SETTINGS, "axes.titlesize": 10}):
        figure = Figure(figsize=(10.5, 6.4 if truth is not None else 3.4), layout="constrained")
        axes = figure.subplots(2 if truth is not None else 1, 2).ravel().tolist()
        if truth is not None:
            _position_panel(axes[0], sides, truth)
            _stress_panel(axes[1], sides, truth)
        _innovation_panel(axes[-2], view)
        latency_panel(axes[-1], view)
        for axis in axes[:-1]:
            axis.set_xlabel("time [s]")
            _shade_faults(axis, view)
            if axis.get_legend_handles_labels()[0]:
                axis.legend(frameon=False, fontsize=8)
        figure.suptitle(f"Twin on {view.count} frames" + (f" ({view.source})" if view.source else ""), fontsize=11)
        return png_of(figure)


def _position_panel(axis: Axes, sides: list[tuple[TwinView, dict[str, Any]]], truth: TwinView) -> None:
    for side, style in sides:
        far = np.maximum(1e3 * distances(side, truth)[:, ~side.body.clamped], _LEAST)
        low, high = np.percentile(far, [5, 95], axis=1)
        axis.plot(side.times, far.mean(axis=1), label=side.name, **style)
        axis.fill_between(side.times, low, high, color=style["color"], alpha=0.15, lw=0)
    axis.set(title="distance from the true place (mean; 5 % to 95 % of nodes)", ylabel="[mm]")
    _log_up(axis)


def _stress_panel(axis: Axes, sides: list[tuple[TwinView, dict[str, Any]]], truth: TwinView) -> None:
    for side, style in sides:
        curves = relative_errors(side, truth)
        for width, name in zip((1.8, 0.9), SHOWN_ERRORS, strict=True):
            if name in curves:
                label = f"{side.name}: {ERROR_NAMES[name]}"
                axis.plot(side.times, 100 * curves[name], lw=width, label=label, **style)
    axis.set(title="stress error / root mean square of the truth", ylabel="[%]")
    _log_up(axis)


def _innovation_panel(axis: Axes, view: TwinView) -> None:
    assert view.innovation is not None
    flat = 1e3 * view.innovation.reshape(view.count, -1)
    known = np.isfinite(flat).any(axis=1)
    axis.plot(view.times, 1e3 * view.innovation_rms(), color="#0072B2", label="root mean square")
    if known.any():
        worst = np.full(view.count, np.nan)
        worst[known] = np.nanmax(flat[known], axis=1)
        axis.plot(view.times, worst, color="#56B4E9", lw=0.8, label="worst node")
    axis.set(title="innovation: observed less predicted place", ylabel="[mm]")
    axis.set_ylim(bottom=0)


@runtime_checkable
class Timed(Protocol):
    """A run whose parts were timed: part -> [frames] ms, their sum without waiting, and what is left of a series
    without its first frames."""

    latency: Mapping[str, Float[np.ndarray, " frames"]]

    def milliseconds(self) -> Float[np.ndarray, " frames"]:
        """Sum of all parts but the waiting for a picture."""

    def warm(self, series: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " kept"]:
        """A series without the first frames."""


def latency_panel(axis: Axes, view: Timed, seed_milliseconds: float = SEED_MILLISECONDS) -> None:
    """Histograms of the milliseconds of every part and of their sum, on a logarithmic axis."""
    axis.set(title="latency of a frame by part", xlabel="milliseconds", ylabel="frames")
    parts: list[tuple[str, Float[np.ndarray, " frames"], str]] = [
        (name, values, _PARTS[k % len(_PARTS)]) for k, (name, values) in enumerate(view.latency.items())
    ]
    if not parts:
        axis.text(0.5, 0.5, "not measured", ha="center", va="center", transform=axis.transAxes)
        return
    parts.append((_SUM, view.milliseconds(), "#000000"))
    positive = np.concatenate([v[np.isfinite(v) & (v > 0)] for _, values, _ in parts for v in [view.warm(values)]])
    low, high = max(float(positive.min(initial=1e-2)), 1e-2), max(float(positive.max(initial=1.0)), 2e-2)
    bins = np.geomspace(0.8 * low, 1.25 * max(high, seed_milliseconds), 60).tolist()
    for name, values, colour in parts:
        known = view.warm(values)
        known = known[np.isfinite(known) & (known > 0)]
        if len(known) == 0:
            continue
        p50, p99 = np.percentile(known, [50, 99])
        style: dict[str, Any] = (
            {"histtype": "stepfilled", "alpha": 0.55} if name != _SUM else {"histtype": "step", "lw": 1.6}
        )
        axis.hist(
            np.clip(known, bins[0], bins[-1]), bins=bins, color=colour, label=f"{name}: {p50:.2f} / {p99:.2f}", **style
        )
    axis.axvline(seed_milliseconds, color="#777777", ls=":", lw=1.4, label=f"seed's frame, {seed_milliseconds:g}")
    axis.set_xscale("log")
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_ylim(top=1.65 * axis.get_ylim()[1])  # room for what the colours mean
    axis.legend(frameon=False, fontsize=8, title="median / 99 % [ms]", title_fontsize=8, loc="upper left", ncols=2)


def _log_up(axis: Axes) -> None:
    """A logarithmic axis with plain numbers; a run without any error stays linear."""
    if any(np.nanmax(line.get_ydata(), initial=0.0) > 0 for line in axis.lines):
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.yaxis.set_minor_formatter(FuncFormatter(_two_and_five))


def _two_and_five(value: float, _: object) -> str:
    """Names of ticks between powers of ten: only those that begin with 2 or 5."""
    return f"{value:g}" if f"{value:e}"[0] in "25" else ""


def _shade_faults(axis: Axes, view: TwinView) -> None:
    """Where the twin went on alone, and, fainter, where a part of the nodes was hidden."""
    assert view.seen is not None
    alone = np.array([bool(f) for f in view.faults])
    partly = ~alone & (view.seen.reshape(view.count, -1).mean(axis=1) < _PARTLY)
    half = 0.5 * float(np.median(np.diff(view.times))) if view.count > 1 else 0.0
    for flags, alpha, label in ((alone, 0.25, "not corrected"), (partly, 0.1, "partly hidden")):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
        for start, stop in edges.reshape(-1, 2):
            axis.axvspan(
                view.times[start] - half, view.times[stop - 1] + half, color=_FAULT, alpha=alpha, lw=0, label=label
            )
            label = "_nolegend_"
