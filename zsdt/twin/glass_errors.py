"""How far a run of a glass twin is from the truth of the virtual lab, frame by frame.

The twin's particles are not those of the lab, so fields are compared where the lab's particles are. Between the twin's
particles its velocity is the thin-plate spline through them: it is theirs where they are, and exact for linear flows.
What is still not the twin's fault is told beside it: the `floor`, what the truth itself would score on the twin's
particles. `NEAR_MEAN` is the measure of former reports, a kernel-weighted mean of the particles within two spacings: it
flattens a flow that turns within a glass by a sixth, whatever the twin does.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from zsdt.twin.glass_view import GlassTwinView

SUPPORT = 2.0  # particle spacings of the twin: reach of the kernel of a mean
NEIGHBOURS = 24  # of the lab's particles, through which the truth at a particle of the twin is told
QUIET = 0.05  # of the largest root mean square of the true vertical velocity, below which a liquid counts as at rest

# What a curve is called for people.
ERROR_NAMES = {
    "level_mm": "level profile [mm]",
    "centroid_mm": "centroid [mm]",
    "vertical_velocity": "vertical velocity",
}


class Between(Enum):
    """How a velocity between particles is told. spline: thin-plate spline through all of them. near_mean: mean of the
    particles within `SUPPORT` spacings, weighted by a Wendland kernel (Shepard)."""

    spline = "spline"
    near_mean = "near_mean"


def spline_at(
    particles: Float[np.ndarray, "particles 3"],
    values: Float[np.ndarray, "particles components"],
    points: Float[np.ndarray, "points 3"],
    neighbours: int | None = None,
) -> Float[np.ndarray, "points components"]:
    """Values at `points` [m] of the thin-plate spline with linear terms through particles [m] (the nearest `neighbours`
    of each point, None: all)."""
    nearest = None if neighbours is None or neighbours >= len(particles) else neighbours
    spline = RBFInterpolator(particles, values, kernel="thin_plate_spline", degree=1, neighbors=nearest)
    return np.asarray(spline(points))


def velocity_at(
    view: GlassTwinView, row: int, points: Float[np.ndarray, "points 3"], between: Between = Between.spline
) -> Float[np.ndarray, "points 3"]:
    """Velocity [m/s] of the run's liquid in moving row `row` at `points` [m]."""
    if between is Between.spline:
        return spline_at(view.positions[row], view.fields["velocity"][row], points)
    return _near_mean(view, row, points)


def _near_mean(view: GlassTwinView, row: int, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Mean of the particles near by; the nearest one's velocity where none is in reach."""
    positions = view.positions[row]
    reach = SUPPORT * view.body.pitch
    tree = cKDTree(positions)
    near: Any = tree.query(points, k=min(24, len(positions)))
    far, found = near
    weights = np.where(far < reach, (1.0 - far / reach).clip(0.0) ** 4 * (1.0 + 4.0 * far / reach), 0.0)
    weights[:, 0] = np.maximum(weights[:, 0], 1e-9)
    velocity = view.fields["velocity"][row]
    return np.einsum("pk,pki->pi", weights, velocity[found]) / weights.sum(axis=1, keepdims=True)


def error_curves(
    view: GlassTwinView, truth: GlassTwinView, vertical: Float[np.ndarray, " moving"] | None = None
) -> dict[str, Float[np.ndarray, " moving"]]:
    """Errors of every frame with particles. vertical [m/s]: of `vertical_error`, where it is known.

    level_mm: root mean square over the columns of the profile; centroid_mm: distance; vertical_velocity: root mean
    square over the lab's particles, over that of the truth in the frame where it is largest [-].
    """
    loudest = max(float(truth.rise().max()), 1e-12)
    known = np.isfinite(view.level - truth.level)
    squares = np.where(known, np.square(view.level - truth.level), 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return {
        "level_mm": 1e3 * np.sqrt(squares),
        "centroid_mm": 1e3 * np.linalg.norm(view.centroid() - truth.centroid(), axis=1),
        "vertical_velocity": (vertical_error(view, truth) if vertical is None else vertical) / loudest,
    }


def vertical_error(
    view: GlassTwinView, truth: GlassTwinView, between: Between = Between.spline
) -> Float[np.ndarray, " moving"]:
    """Error of the vertical velocity [m/s] in every frame with particles, root mean square over the lab's particles."""
    found = np.empty(len(view.positions))
    for k in range(len(found)):
        off = velocity_at(view, k, truth.positions[k], between)[:, 2] - truth.fields["velocity"][k][:, 2]
        found[k] = np.sqrt(np.mean(off**2))
    return found


def error_and_floor(
    view: GlassTwinView, truth: GlassTwinView
) -> tuple[Float[np.ndarray, " moving"], Float[np.ndarray, " moving"]]:
    """`vertical_error` by the spline, and the same [m/s] of a twin whose particles, where they are, move exactly as the
    truth does there: what no twin of these particles can fall below by this measure."""
    found = np.empty((len(view.positions), 2))
    for k in range(len(found)):
        true = truth.fields["velocity"][k][:, 2:]
        perfect = spline_at(truth.positions[k], true, view.positions[k], NEIGHBOURS)
        both = np.column_stack([view.fields["velocity"][k][:, 2], perfect])
        found[k] = np.sqrt(np.mean((spline_at(view.positions[k], both, truth.positions[k]) - true) ** 2, axis=0))
    return found[:, 0], found[:, 1]


def vertical_velocity_rrmse(view: GlassTwinView, truth: GlassTwinView, between: Between = Between.spline) -> float:
    """Root of the summed squared error of the vertical velocity over all frames but the first, over that of the truth,
    at the lab's particles."""
    return share_of_truth(vertical_error(view, truth, between), truth)


def share_of_truth(error: Float[np.ndarray, " moving"], truth: GlassTwinView) -> float:
    """An error of the vertical velocity [m/s] over all frames but the first, over the truth's; NaN for one at rest."""
    scale = float(np.square(truth.rise()[1:]).sum())
    return float(np.sqrt(np.square(error[1:]).sum() / scale)) if scale > 0 else float("nan")


def rest_time(view: GlassTwinView, loudest: float) -> float:
    """Time after t0 [s] from which on the vertical velocity stays below `QUIET` times `loudest` [m/s]; the end of the
    clip where it never does."""
    loud = np.flatnonzero(view.rise() > QUIET * loudest)
    return float(view.clock[min(int(loud[-1]) + 1, len(view.clock) - 1)]) if len(loud) else 0.0
