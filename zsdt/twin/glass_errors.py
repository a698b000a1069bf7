"""How far a run of a glass twin is from the truth of the virtual lab, frame by frame.

The twin's particles are not those of the lab, so fields are compared where the lab's particles are: the twin's
velocity there is its kernel-weighted mean (Shepard interpolation with a Wendland kernel).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from zsdt.twin.glass_view import GlassTwinView

SUPPORT = 2.0  # particle spacings of the twin: reach of the kernel
QUIET = 0.05  # of the largest root mean square of the true vertical velocity, below which a liquid counts as at rest

# What a curve is called for people.
ERROR_NAMES = {
    "level_mm": "level profile [mm]",
    "centroid_mm": "centroid [mm]",
    "vertical_velocity": "vertical velocity",
}


def velocity_at(view: GlassTwinView, row: int, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Velocity [m/s] of the run's liquid in moving row `row` at `points` [m]; that of the nearest particle where none
    is in reach."""
    positions = view.positions[row]
    reach = SUPPORT * view.body.pitch
    tree = cKDTree(positions)
    near: Any = tree.query(points, k=min(24, len(positions)))
    far, found = near
    weights = np.where(far < reach, (1.0 - far / reach).clip(0.0) ** 4 * (1.0 + 4.0 * far / reach), 0.0)
    weights[:, 0] = np.maximum(weights[:, 0], 1e-9)
    velocity = view.fields["velocity"][row]
    return np.einsum("pk,pki->pi", weights, velocity[found]) / weights.sum(axis=1, keepdims=True)


def error_curves(view: GlassTwinView, truth: GlassTwinView) -> dict[str, Float[np.ndarray, " moving"]]:
    """Errors of every frame with particles.

    level_mm: root mean square over the columns of the profile; centroid_mm: distance; vertical_velocity: root mean
    square over the lab's particles, over that of the truth in the frame where it is largest [-].
    """
    rows = range(len(view.positions))
    off = np.array([velocity_at(view, k, truth.positions[k])[:, 2] - truth.fields["velocity"][k][:, 2] for k in rows])
    loudest = max(float(truth.rise().max()), 1e-12)
    known = np.isfinite(view.level - truth.level)
    squares = np.where(known, np.square(view.level - truth.level), 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return {
        "level_mm": 1e3 * np.sqrt(squares),
        "centroid_mm": 1e3 * np.linalg.norm(view.centroid() - truth.centroid(), axis=1),
        "vertical_velocity": np.sqrt(np.mean(off**2, axis=1)) / loudest,
    }


def vertical_velocity_rrmse(view: GlassTwinView, truth: GlassTwinView) -> float:
    """Root of the summed squared error of the vertical velocity over all frames but the first, over that of the truth,
    at the lab's particles."""
    off, scale = 0.0, 0.0
    for k in range(1, len(view.positions)):
        true = truth.fields["velocity"][k][:, 2]
        off += float(np.mean((velocity_at(view, k, truth.positions[k])[:, 2] - true) ** 2))
        scale += float(np.mean(true**2))
    return float(np.sqrt(off / scale)) if scale > 0 else float("nan")


def rest_time(view: GlassTwinView, loudest: float) -> float:
    """Time after t0 [s] from which on the vertical velocity stays below `QUIET` times `loudest` [m/s]; the end of the
    clip where it never does."""
    loud = np.flatnonzero(view.rise() > QUIET * loudest)
    return float(view.clock[min(int(loud[-1]) + 1, len(view.clock) - 1)]) if len(loud) else 0.0
