"""One figure that sums up a run of a glass twin: levels at the walls, centroid, velocity, volume, innovation, latency.

Colours are those of Okabe and Ito; each side has a line style of its own as well.
"""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsdt.evaluation.plots import SETTINGS, png_of
from zsdt.twin.glass_view import GlassTwinView
from zsdt.twin.twin_plots import latency_panel

_CLOSED: dict[str, Any] = {"color": "#009E73", "ls": "-"}
_OPEN: dict[str, Any] = {"color": "#D55E00", "ls": "--"}
_TRUTH: dict[str, Any] = {"color": "#0072B2", "ls": "-", "lw": 1.1}
_SEEN: dict[str, Any] = {"color": "#777777", "ls": "none", "marker": ".", "ms": 4}
_FAULT = "#CC79A7"
SEED_MILLISECONDS = 25.2  # of one frame in the seed, on a GPU

Side = tuple[GlassTwinView, dict[str, Any]]


def glass_summary(
    view: GlassTwinView, truth: GlassTwinView | None = None, open_loop: GlassTwinView | None = None
) -> bytes:
    """PNG with panels for the level at both walls, centroid, vertical velocity, volume, innovation and latency.

    open_loop: the same clip without correction; truth: of the virtual lab.
    """
    sides: list[Side] = [(view, _CLOSED if view.closed else _OPEN)]
    sides += [(open_loop, _OPEN)] if open_loop is not None else []
    sides += [(truth, _TRUTH)] if truth is not None else []
    with mpl.rc_context({**SETTINGS, "axes.titlesize": 10}):
        figure = Figure(figsize=(12.5, 7.0), layout="constrained")
        axes = figure.subplots(2, 3).ravel().tolist()
        _wall_panel(axes[0], sides, view, 0)
        _wall_panel(axes[1], sides, view, 1)
        _speed_panel(axes[2], sides)
        _centroid_panel(axes[3], sides)
        _check_panel(axes[4], view, sides)
        latency_panel(axes[5], view, SEED_MILLISECONDS)
        for axis in axes[:-1]:
            axis.set_xlabel("time after t0 [s]")
            _shade_faults(axis, view)
            axis.legend(frameon=False, fontsize=8)
        liquid = view.body.liquid.name if view.body.liquid is not None else "liquid"
        words = f"Twin of {liquid} on {view.count - view.start} frames, {view.body.nodes} particles"
        figure.suptitle(words + (f" ({view.source})" if view.source else ""), fontsize=11)
        return png_of(figure)


def _wall_panel(axis: Axes, sides: list[Side], view: GlassTwinView, wall: int) -> None:
    seen = view.seen_walls()[:, wall]
    if np.isfinite(seen).any():
        axis.plot(view.clock, 1e3 * seen, label="seen", **_SEEN)
    for side, style in sides:
        axis.plot(side.clock, 1e3 * side.walls()[:, wall], label=side.name, **style)
    axis.set(title=f"level at the {('left', 'right')[wall]} wall", ylabel="[mm]")


def _speed_panel(axis: Axes, sides: list[Side]) -> None:
    for side, style in sides:
        if side.shows("velocity"):
            axis.plot(side.clock, 1e3 * side.rise(), label=side.name, **style)
    axis.set(title="vertical velocity, root mean square of the particles", ylabel="[mm/s]")
    axis.set_ylim(bottom=0)


def _centroid_panel(axis: Axes, sides: list[Side]) -> None:
    for side, style in sides:
        axis.plot(side.clock, 1e3 * side.centroid()[:, 0], label=side.name, **style)
    axis.set(title="centroid along the motion", ylabel="[mm]")


def _check_panel(axis: Axes, view: GlassTwinView, sides: list[Side]) -> None:
    """Innovation on the left, change of the volume below the surface on the right."""
    innovation = 1e3 * view.innovation_rms()
    if np.isfinite(innovation).any():
        axis.plot(view.clock, innovation, color="#0072B2", label="innovation, rms of the columns")
    axis.set(title="innovation, and volume below the surface", ylabel="[mm]")
    axis.set_ylim(bottom=0)
    beside = axis.twinx()
    beside.grid(visible=False)
    for side, style in sides:
        volume = np.asarray(side.account.get("volume", np.zeros(0)))
        if len(volume):
            axis.plot([], [], label=f"volume, {side.name}", **{**style, "lw": 0.9})
            beside.plot(side.clock, 100 * (volume / volume[0] - 1.0), **{**style, "lw": 0.9})
    beside.set_ylabel("change of volume [%]")
    low, high = beside.get_ylim()
    beside.set_ylim(min(low, -2.0), max(high, 2.0))


def _shade_faults(axis: Axes, view: GlassTwinView) -> None:
    """Where the twin went on alone."""
    alone = np.array([bool(f) for f in view.faults[view.start :]])
    half = 0.5 * float(np.median(np.diff(view.clock))) if len(alone) > 1 else 0.0
    label = "not corrected"
    edges = np.flatnonzero(np.diff(np.concatenate([[False], alone, [False]]).astype(int)))
    for start, stop in edges.reshape(-1, 2):
        axis.axvspan(view.clock[start] - half, view.clock[stop - 1] + half, color=_FAULT, alpha=0.25, lw=0, label=label)
        label = "_nolegend_"
