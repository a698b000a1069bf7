"""Plots of liquids: slices through the vessel, centroid and surface over time, energies beside the solver's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from zsdt.evaluation.liquid_metrics import Swing, field_energies
from zsdt.evaluation.outline import outline
from zsdt.evaluation.plots import NOTHING_MOVES, SETTINGS, png_of, style_of
from zsdt.evaluation.sloshing import centroid, fit_window
from zsdt.fluid.vessel import Vessel
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Body, Trajectory

TRUTH = "#000000"
INSTANTS = (0.0, 0.12, 0.28, 0.45, 0.7, 1.0)  # of the time until the truth has come to rest
MOST_ROWS = 5  # methods in a strip of snapshots
COLUMN = 1.75  # inches: width of a snapshot
SLICE = 0.8  # spacings: half the thickness of a slice
PARTS = {"kinetic": "#0072B2", "potential": "#E69F00", "internal": "#D55E00"}


def snapshots(trajectory: Trajectory, rollouts: Mapping[str, Rollout], direction: Float[np.ndarray, "3"]) -> bytes:
    """A strip of slices through the axis along the swing, coloured by vertical velocity: truth above, methods below.

    The instants follow the true swing until it has faded; the colours are the same everywhere.
    """
    body, truth = trajectory.body, trajectory.fields
    path = centroid(body, truth["position"]) @ direction
    frames = np.unique((np.array(INSTANTS) * (fit_window(path) - 1)).astype(int))
    rows = {"truth": truth} | {name: rollouts[name].fields for name in _shown(rollouts)}
    top = 100.0 * float(np.percentile(np.abs(truth["velocity"][frames][..., 2]), 98)) or 1.0
    figure, axes = _grid(len(rows), len(frames), COLUMN, COLUMN * _aspect(body, truth["position"], direction) + 0.1)
    dots = None
    for row, (name, fields) in enumerate(rows.items()):
        for column, frame in enumerate(frames):
            axis = axes[row][column]
            dots = _slice(axis, body, fields, int(frame), direction, top)
            _cup(axis, trajectory, direction)
            if row == 0:
                axis.set_title(f"{1e3 * trajectory.times[frame]:.0f} ms", fontsize=10)
        axes[row][0].set_ylabel(name, fontsize=10)
    if dots is not None:
        bar = figure.colorbar(dots, ax=[a for line in axes for a in line], shrink=0.8, pad=0.01, aspect=30)
        ticks = [sign * round(share * top, 1) for sign in (-1, 1) for share in (0.1, 0.3, 1.0)]
        bar.set_ticks(sorted([0.0, *ticks]), labels=[f"{t:.2g}" for t in sorted([0.0, *ticks])])
        bar.ax.minorticks_off()
        bar.set_label("vertical velocity [cm/s]")
    figure.suptitle(_title(trajectory), fontsize=11)
    return png_of(figure)


def _shown(rollouts: Mapping[str, Rollout]) -> list[str]:
    moving = [name for name in rollouts if name not in (NOTHING_MOVES, "inertia")]
    return (moving or list(rollouts))[:MOST_ROWS]


def _title(trajectory: Trajectory) -> str:
    body = trajectory.body
    family = body.vessel.family.value if body.vessel is not None else "vessel"
    liquid = body.liquid.name if body.liquid is not None else "liquid"
    return f"{trajectory.name}: {liquid} in a {family}, {body.nodes} particles, slice along the swing"


def _aspect(body: Body, position: np.ndarray, direction: np.ndarray) -> float:
    width, height = _extent(body, position, direction)
    return height / (2.0 * width)


def _extent(body: Body, position: np.ndarray, direction: np.ndarray) -> tuple[float, float]:
    """Half width and height [m] of what a slice shows."""
    height = float(position[..., 2].max()) + 1.5 * body.pitch
    if body.vessel is None:
        return float(np.abs(position @ direction).max()) + body.pitch, height
    place, _ = outline(Vessel(body.vessel), direction)
    return float(np.abs(place).max()) + 0.5 * body.pitch, min(height, body.vessel.rim + body.pitch)


def _slice(
    axis: Axes, body: Body, fields: Mapping[str, np.ndarray], frame: int, direction: np.ndarray, top: float
) -> Any:
    position, velocity = fields["position"][frame], fields["velocity"][frame]
    width, _ = _extent(body, fields["position"][:1], direction)
    size = (0.85 * 72 * COLUMN * body.pitch / (2.0 * width)) ** 2  # points squared: a dot is nearly a spacing wide
    across = position @ np.array([-direction[1], direction[0], 0.0])
    inside = np.flatnonzero(np.abs(across) < SLICE * body.pitch)
    order = inside[np.argsort(-np.abs(across[inside]))]
    return axis.scatter(
        100 * position[order] @ direction,
        100 * position[order, 2],
        c=100 * velocity[order, 2],
        s=size,
        cmap="RdBu_r",
        norm=SymLogNorm(0.1 * top, vmin=-top, vmax=top),
        edgecolors="#555555",
        linewidths=0.25,
    )


def _cup(axis: Axes, trajectory: Trajectory, direction: np.ndarray) -> None:
    body = trajectory.body
    if body.vessel is not None:
        place, height = outline(Vessel(body.vessel), direction)
        axis.plot(100 * place, 100 * height, color="#444444", lw=1.4, solid_capstyle="butt")
    width, top = _extent(body, trajectory.fields["position"], direction)
    axis.set(xlim=(-100 * width, 100 * width), ylim=(-0.3, 100 * top), aspect="equal", xticks=[], yticks=[])
    axis.grid(False)
    for side in axis.spines.values():
        side.set_visible(False)


def sloshing(times: Float[np.ndarray, " frames"], truth: Swing, methods: Mapping[str, Swing], title: str = "") -> bytes:
    """Centroid along the swing and height of the surface at the wall, in front and behind, over time [mm, s]."""
    figure, ((left, right),) = _grid(1, 2, 5.6, 4.2)
    for name, swing in {**methods, "truth": truth}.items():
        colour, marker = style_of(name)
        count = min(len(times), len(swing.along))
        look: dict[str, Any] = {"color": colour, "marker": marker, "ms": 5, "markevery": max(count // 8, 1), "lw": 1.6}
        if name == "truth":
            look = {"color": "#9a9a9a", "lw": 5.0, "alpha": 0.8, "zorder": 1}
        left.plot(times[:count], 1e3 * swing.along[:count], label=name, **look)
        right.plot(times[:count], 1e3 * swing.levels[:count, 0], **look)
        right.plot(times[:count], 1e3 * swing.levels[:count, 1], ls="--", **look)
    left.set(title="centroid along the swing", xlabel="time [s]", ylabel="mm from the axis")
    right.set(title="surface at the wall: in front (-), behind (--)", xlabel="time [s]", ylabel="mm above the floor")
    _frame_on(left, 1e3 * truth.along)
    _frame_on(right, 1e3 * truth.levels)
    figure.legend(loc="outside lower center", ncols=min(len(methods) + 1, 6), frameon=False)
    if title:
        figure.suptitle(title, fontsize=11)
    return png_of(figure)


def _frame_on(axis: Axes, truth: np.ndarray) -> None:
    """Limits that show the truth well, and as much of the methods as goes in half as far again."""
    low, high = float(np.nanmin(truth)), float(np.nanmax(truth))
    room = 0.35 * max(high - low, 1.0)
    axis.set_ylim(low - room, high + room)


def energies(trajectory: Trajectory, rollouts: Mapping[str, Rollout]) -> bytes:
    """Kinetic, potential and internal energy and their sum [mJ], less those of the first true frame: one panel a
    method, the solver's as broken lines.
    """
    body = trajectory.body
    names = _shown(rollouts)
    theirs = field_energies(body, trajectory.fields)
    figure, (axes,) = _grid(1, len(names), 3.7 if len(names) > 2 else 4.6, 3.9, share=True)
    for axis, name in zip(axes, names, strict=True):
        ours = field_energies(body, rollouts[name].fields)
        for account, ls, width, alpha in ((theirs, "--", 1.4, 0.8), (ours, "-", 1.8, 1.0)):
            total = np.sum(list(account.values()), axis=0)
            base = {k: v[0] for k, v in theirs.items()} | {"total": float(np.sum([v[0] for v in theirs.values()]))}
            for part, values in {**account, "total": total}.items():
                if part == "total" and len(account) < len(PARTS):
                    continue
                count = min(len(values), trajectory.frames)
                start = 0.0 if part == "kinetic" else base[part]
                label = part if ls == "-" and axis is axes[0] else None
                colour = PARTS.get(part, TRUTH)
                shown = 1e3 * (values[:count] - start)
                axis.plot(trajectory.times[:count], shown, ls=ls, lw=width, alpha=alpha, color=colour, label=label)
        axis.set(title=name, xlabel="time [s]")
    axes[0].set_ylabel("energy [mJ]")
    changes = np.stack([v - (0.0 if k == "kinetic" else v[0]) for k, v in theirs.items()])
    low, high = 1e3 * float(changes.min()), 1e3 * float(changes.max())
    axes[0].set_ylim(low - 0.5 * (high - low), high + 0.35 * (high - low))
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(f"{_title(trajectory).split(',')[0]}; broken lines: the solver", fontsize=11)
    return png_of(figure)


def _grid(rows: int, columns: int, width: float, height: float, share: bool = False) -> tuple[Figure, list[list[Axes]]]:
    import matplotlib

    with matplotlib.rc_context(SETTINGS):
        figure = Figure(figsize=(width * columns + 0.6, height * rows + 0.6), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharey=share)
    return figure, [list(line) for line in axes]
