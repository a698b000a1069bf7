"""Walls of a vessel as the compiled sub-steps see them: a flat floor and a side whose distance is a plane table.

A round vessel needs its side's distance over (radius, height), a prism over (x, y). What a wall does to the sums of a
particle comes from `WallTables` (DESIGN 3.2); distances here say how near it is, for the barrier and the guard.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple, no_type_check

import numba as nb
import numpy as np
from jaxtyping import Float

from zsdt.fluid.vessel import Vessel
from zsdt.fluid.wall_tables import WallTables
from zsdt.scene import VesselShape

_fast = nb.njit(cache=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy", boundscheck=False)
POINTS_ROUND = 720  # of the outline of a prism
CELLS = 8  # of the plane table per particle spacing
FINENESS = 5.0  # of the integrals over the wall, per half of the cutoff


class Walls(NamedTuple):
    """table [a, b] m: distance from the side wall, positive inside, at origin + (a, b) * spacing; round: whether the
    axes are (radius, z) or (x, y). rows, low, inverse: `WallTables` of the vessel."""

    table: Any
    origin: Any
    spacing: float
    round: bool
    rows: Any
    low: Any
    inverse: float


def walls_of(shape: VesselShape, pitch: float, cutoff: float) -> Walls:
    """Walls of `shape` for particles of spacing `pitch` [m] that feel them up to `cutoff` [m]; takes about a second."""
    integrals = WallTables(Vessel(shape), 0.5 * cutoff, FINENESS)
    plane = (_round_side if shape.is_round else _prism_side)(shape, pitch / CELLS, cutoff + pitch)
    return Walls(*plane, shape.is_round, integrals.table, integrals.low, integrals.inverse_spacing)


def _prism_side(shape: VesselShape, spacing: float, margin: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Table of the side of `shape` with `spacing` [m] that reaches `margin` [m] into the wall.

    Above the rim the wall goes on upwards, below the floor downwards.
    """
    angle = np.arange(POINTS_ROUND) * 2 * np.pi / POINTS_ROUND
    a, b, power = shape.radii[0], shape.radii[0] * shape.aspect, 2.0 / shape.exponent
    cos, sin = np.cos(angle), np.sin(angle)
    outline = np.stack([a * np.sign(cos) * np.abs(cos) ** power, b * np.sign(sin) * np.abs(sin) ** power], axis=1)
    reach = np.array([a, b]) + margin
    u, v = (np.arange(-r, r + spacing, spacing) for r in reach)
    points = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    inside = np.abs(points[..., 0] / a) ** shape.exponent + np.abs(points[..., 1] / b) ** shape.exponent < 1
    table = _polyline_distance(points, np.vstack([outline, outline[:1]])) * np.where(inside, 1.0, -1.0)
    return np.ascontiguousarray(table), -reach, float(spacing)


def _round_side(shape: VesselShape, spacing: float, margin: float) -> tuple[np.ndarray, np.ndarray, float]:
    heights, radii = np.array(shape.heights), np.array(shape.radii)
    below = radii[0] + min((radii[1] - radii[0]) / (heights[1] - heights[0]), 1.0) * -margin
    line = np.vstack(
        [[max(below, 0.2 * radii[0]), -margin], np.stack([radii, heights], axis=1), [radii[-1], heights[-1] + 1.0]]
    )
    u = np.arange(0.0, radii.max() + margin + spacing, spacing)
    v = np.arange(-margin, heights[-1] + 3 * margin, spacing)
    points = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    inside = points[..., 0] < np.interp(points[..., 1], line[:, 1], line[:, 0])
    table = _polyline_distance(points, line) * np.where(inside, 1.0, -1.0)
    return np.ascontiguousarray(table), np.array([0.0, -margin]), float(spacing)


def _polyline_distance(
    points: Float[np.ndarray, "a b 2"], line: Float[np.ndarray, "corners 2"]
) -> Float[np.ndarray, "a b"]:
    """Unsigned distance [m] from the segments of `line`."""
    best = np.full(points.shape[:2], np.inf)
    for start, end in itertools.pairwise(line):
        along = end - start
        length = float(along @ along)
        share = np.clip((points - start) @ along / length, 0.0, 1.0) if length > 0 else np.zeros(points.shape[:2])
        best = np.minimum(best, np.linalg.norm(points - start - share[..., None] * along, axis=-1))
    return best


@_fast
@no_type_check
def side_distance(walls, x, y, z, out):
    """Distance [m] from the side and its gradient (unit length) at a point, out [4]; bilinear."""
    table = walls.table
    radius = math.sqrt(x * x + y * y)
    u, v = (radius, z) if walls.round else (x, y)
    a = (u - walls.origin[0]) / walls.spacing
    b = (v - walls.origin[1]) / walls.spacing
    i = min(max(int(a), 0), table.shape[0] - 2)
    j = min(max(int(b), 0), table.shape[1] - 2)
    a, b = a - i, b - j
    low, high = table[i, j], table[i + 1, j]
    low_next, high_next = table[i, j + 1], table[i + 1, j + 1]
    out[0] = (low + (high - low) * a) * (1.0 - b) + (low_next + (high_next - low_next) * a) * b
    du = (high - low) * (1.0 - b) + (high_next - low_next) * b
    dv = (low_next - low) * (1.0 - a) + (high_next - high) * a
    size = 1.0 / (math.sqrt(du * du + dv * dv) + 1e-30)
    if walls.round:
        s = du * size / (radius + 1e-30)
        out[1], out[2], out[3] = s * x, s * y, dv * size
    else:
        out[1], out[2], out[3] = du * size, dv * size, 0.0
