"""Height of the free surface at the wall of a vessel of any shape, in front and behind, from particles.

Particles are smoothed with a Wendland kernel of 2.5 spacings along columns that climb the wall one spacing away from
it. Where the share of the kernel that is filled falls through one half is the surface; a lone drop fills less, so it
is no surface. The part of the kernel that the wall cuts off is counted as if the wall were plane.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from zsdt.evaluation.outline import UP, reach
from zsdt.fluid.vessel import Vessel
from zsdt.trajectory import Body

SUPPORT = 2.5  # spacings: reach of the kernel
INSET = 1.0  # spacings: distance of a column from the wall
STEP = 0.25  # spacings: between the heights of a column
SECTOR = np.radians([-20.0, -10.0, 0.0, 10.0, 20.0])  # directions of the columns about the main one


def wall_levels(
    body: Body, position: Float[np.ndarray, "frames nodes 3"], direction: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "frames 2"]:
    """Heights [m] of the free surface above the floor of the vessel at its wall, in `direction` and opposite to it.

    Each is the mean over a sector of 40 degrees. NaN in frames that are not finite.
    """
    columns = np.concatenate([_columns(body, sign * direction) for sign in (1.0, -1.0)])
    scale = SUPPORT * body.pitch
    weight = body.pitch**3 / scale**3 * 21.0 / (2.0 * np.pi) / _inner_share(INSET / SUPPORT)
    heights = columns[0, :, 2]
    levels = np.full((len(position), 2), np.nan)
    for frame, points in enumerate(position):
        if np.isfinite(points).all():
            filled = weight * _smoothed(np.ascontiguousarray(points), columns, scale)
            tops = np.array([_highest_crossing(heights, column) for column in filled])
            levels[frame] = tops.reshape(2, -1).mean(axis=1)
    return levels


def _columns(body: Body, direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "columns heights 3"]:
    """Points [m] one inset away from the wall, from the bottom to the rim, for each direction of the sector."""
    if body.vessel is None:
        raise ValueError("only a body in a vessel has a surface at a wall")
    vessel = Vessel(body.vessel)
    inset = INSET * body.pitch
    heights = np.arange(1.01 * inset, body.vessel.rim, STEP * body.pitch)  # clear of the floor
    middle = np.arctan2(direction[1], direction[0])
    columns = []
    for angle in middle + SECTOR:
        ray = np.array([np.cos(angle), np.sin(angle), 0.0])
        columns.append(reach(vessel, heights, ray, inset)[:, None] * ray + heights[:, None] * UP)
    return np.stack(columns)


def _inner_share(distance: float) -> float:
    """Share of the kernel on the inner side of a plane wall, `distance` supports away."""
    r = np.linspace(distance, 1.0, 400)
    return 1.0 - float(np.trapezoid(21.0 * (1 - r) ** 4 * (1 + 4 * r) * r * (r - distance), r))


@njit(cache=True, error_model="numpy")
@no_type_check
def _smoothed(points, columns, scale):
    """Sums of `(1 - q)^4 (1 + 4 q)`, q the distance over `scale`, of `points` at the points of `columns`."""
    count, heights, _ = columns.shape
    found = np.zeros((count, heights))
    bottom, step = columns[0, 0, 2], columns[0, 1, 2] - columns[0, 0, 2]
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        first = max(int(np.ceil((z - scale - bottom) / step)), 0)
        last = min(int(np.floor((z + scale - bottom) / step)), heights - 1)
        for c in range(count):
            for k in range(first, last + 1):
                dx, dy, dz = x - columns[c, k, 0], y - columns[c, k, 1], z - columns[c, k, 2]
                square = dx * dx + dy * dy + dz * dz
                if square < scale * scale:
                    q = np.sqrt(square) / scale
                    found[c, k] += (1.0 - q) ** 4 * (1.0 + 4.0 * q)
    return found


def _highest_crossing(heights: Float[np.ndarray, " heights"], filled: Float[np.ndarray, " heights"]) -> float:
    """Where `filled` falls through one half for the last time, between two heights [m]; 0 where the wall is dry."""
    wet = np.flatnonzero(filled >= 0.5)
    if len(wet) == 0:
        return 0.0
    k = int(wet[-1])
    if k + 1 == len(heights):
        return float(heights[-1])
    share = (filled[k] - 0.5) / (filled[k] - filled[k + 1])
    return float(heights[k] + share * (heights[k + 1] - heights[k]))
