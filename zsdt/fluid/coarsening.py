"""Another resolution of the same liquid: fewer particles in the shape that the given ones fill, and values between.

Used where only particles are known, not the level or the surface that they come from.
"""

from __future__ import annotations

import math
import time
from typing import Any, no_type_check

import numba
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from zsdt.fluid.kernel import slope_factor
from zsdt.fluid.sampling import CLEAR, LONGEST, STRIDE
from zsdt.fluid.vessel import Vessel

_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True)

LLOYD_STEPS, PACKING_STEPS = 20, 100
NEIGHBOURS = 32  # of a target: those within 2 spacings
RIDGE = 0.05  # of the linear fit around a target, relative to its weights times h^2


@_jit
@no_type_check
def _linear_fit(targets, nearest, particles, h, values, out):
    """out[i] = value at target i of the linear function that fits `values` of the particles nearest to it.

    Weights are Wendland's; a ridge on the slope makes it a mean where the particles lie in a plane or far away.
    """
    moment = np.empty((3, 3))
    first, slope = np.empty(3), np.empty(3)
    for i in range(len(targets)):
        x, y, z = targets[i, 0], targets[i, 1], targets[i, 2]
        total = 0.0
        moment[:], first[:] = 0.0, 0.0
        for j in nearest[i]:
            dx, dy, dz = particles[j, 0] - x, particles[j, 1] - y, particles[j, 2] - z
            q = math.sqrt(dx * dx + dy * dy + dz * dz) / h
            w = max(1.0 - 0.5 * q, 1e-6) ** 4 * (2.0 * q + 1.0)
            total += w
            d = (dx, dy, dz)
            for a in range(3):
                first[a] += w * d[a]
                for b in range(3):
                    moment[a, b] += w * d[a] * d[b]
        for a in range(3):
            moment[a, a] += RIDGE * total * h * h
        slope[:] = np.linalg.solve(moment, first)
        whole = total - slope[0] * first[0] - slope[1] * first[1] - slope[2] * first[2]
        for c in range(values.shape[1]):
            out[i, c] = 0.0
        for j in nearest[i]:
            dx, dy, dz = particles[j, 0] - x, particles[j, 1] - y, particles[j, 2] - z
            q = math.sqrt(dx * dx + dy * dy + dz * dz) / h
            w = max(1.0 - 0.5 * q, 1e-6) ** 4 * (2.0 * q + 1.0)
            w *= (1.0 - slope[0] * dx - slope[1] * dy - slope[2] * dz) / whole
            for c in range(values.shape[1]):
                out[i, c] += w * values[j, c]


def interpolate(
    targets: Float[np.ndarray, "targets 3"],
    particles: Float[np.ndarray, "particles 3"],
    values: Float[np.ndarray, "particles components"],
    spacing: float,
) -> tuple[Float[np.ndarray, "targets components"], float]:
    """Values at targets [m] by local linear fits to particles of `spacing` [m], and the seconds of the search."""
    began = time.perf_counter()
    nearest = np.asarray(cKDTree(particles).query(targets, k=min(NEIGHBOURS, len(particles)))[1], np.int64)
    took = time.perf_counter() - began
    out = np.empty((len(targets), values.shape[1]))
    _linear_fit(targets, nearest.reshape(len(targets), -1), particles, spacing, np.ascontiguousarray(values), out)
    return out, took


def clusters(points: Float[np.ndarray, "points 3"], count: int, seed: int = 0) -> Float[np.ndarray, "clusters 3"]:
    """Centres [m] of `count` clusters of points, by Lloyd's iteration: an even sampling of the shape they fill."""
    rng = np.random.default_rng(seed)
    centres = points[np.sort(rng.choice(len(points), count, replace=False))].copy()
    for _ in range(LLOYD_STEPS):
        member = np.asarray(cKDTree(centres).query(points)[1], np.int64)
        sizes = np.bincount(member, minlength=count)
        for axis in range(3):
            sums = np.bincount(member, weights=points[:, axis], minlength=count)
            centres[:, axis] = np.where(sizes > 0, sums / np.maximum(sizes, 1), centres[:, axis])
    return centres


@_jit
@no_type_check
def _mismatch(centres, points, h, ratio, out):
    """out[i] = sum over centres of grad W minus that over points weighted with their volume, in units of a centre's."""
    for i in range(len(centres)):
        x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
        gx, gy, gz = 0.0, 0.0, 0.0
        for own in range(2):
            cloud, weight = (centres, 1.0) if own == 0 else (points, -ratio)
            for j in range(len(cloud)):
                dx, dy, dz = x - cloud[j, 0], y - cloud[j, 1], z - cloud[j, 2]
                square = dx * dx + dy * dy + dz * dz
                if square < 4.0 * h * h:
                    t = 1.0 - 0.5 * math.sqrt(square) / h
                    f = weight * t * t * t
                    gx, gy, gz = gx + f * dx, gy + f * dy, gz + f * dz
        out[i, 0], out[i, 1], out[i, 2] = gx, gy, gz


def coarsen(
    points: Float[np.ndarray, "points 3"], count: int, vessel: Vessel, spacing: float, h: float
) -> Float[np.ndarray, "clusters 3"]:
    """`count` particles of `spacing` [m] that sample the same liquid as `points` [m].

    Centres of clusters are packed until the kernel of length h [m] sees the density that it sees of the points, free
    surface included; so no level needs to be known.
    """
    centres = clusters(points, count)
    gradient, factor = np.empty_like(centres), spacing**3 * slope_factor(h)
    for _ in range(PACKING_STEPS):
        _mismatch(centres, points, h, count / len(points), gradient)
        step = -STRIDE * h**2 * factor * gradient
        length = np.linalg.norm(step, axis=1, keepdims=True)
        centres += step * np.minimum(1.0, LONGEST * spacing / (length + 1e-300))
        distance, normal = vessel.distance_and_normal(centres)
        centres += np.maximum(CLEAR * spacing - distance, 0.0)[:, None] * normal
    return centres
