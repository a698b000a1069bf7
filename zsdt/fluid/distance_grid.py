"""Table of the distance to a vessel's wall, for loops that ask for it often."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from zsdt.errors import OptionError
from zsdt.fluid.vessel import Vessel


@njit(cache=True, error_model="numpy")
@no_type_check
def table_distance(table, low, inverse_spacing, x, y, z):
    """Trilinear distance [m] and unit gradient (d, nx, ny, nz) at a point; beyond the table it falls with slope 1.

    table [nx, ny, nz] m; low [3] m: its first corner. Above the table the value at its top holds (walls go on).
    """
    fx, fy, fz = (x - low[0]) * inverse_spacing, (y - low[1]) * inverse_spacing, (z - low[2]) * inverse_spacing
    a = min(max(int(fx), 0), table.shape[0] - 2)
    b = min(max(int(fy), 0), table.shape[1] - 2)
    c = min(max(int(fz), 0), table.shape[2] - 2)
    ux, uy, uz = fx - a, fy - b, fz - c
    fx, fy, fz = min(max(ux, 0.0), 1.0), min(max(uy, 0.0), 1.0), min(max(uz, 0.0), 1.0)
    beyond = (ux - fx) ** 2 + (uy - fy) ** 2 + min(uz - fz, 0.0) ** 2
    t000, t100 = table[a, b, c], table[a + 1, b, c]
    t010, t110 = table[a, b + 1, c], table[a + 1, b + 1, c]
    t001, t101 = table[a, b, c + 1], table[a + 1, b, c + 1]
    t011, t111 = table[a, b + 1, c + 1], table[a + 1, b + 1, c + 1]
    e00, e10 = t000 + (t100 - t000) * fx, t010 + (t110 - t010) * fx
    e01, e11 = t001 + (t101 - t001) * fx, t011 + (t111 - t011) * fx
    low_face, high_face = e00 + (e10 - e00) * fy, e01 + (e11 - e01) * fy
    gx = ((t100 - t000) * (1 - fy) + (t110 - t010) * fy) * (1 - fz) + (
        (t101 - t001) * (1 - fy) + (t111 - t011) * fy
    ) * fz
    gy = (e10 - e00) * (1 - fz) + (e11 - e01) * fz
    gz = high_face - low_face
    length = math.sqrt(gx * gx + gy * gy + gz * gz) + 1e-30
    distance = low_face + gz * fz
    if beyond > 0.0:
        distance -= math.sqrt(beyond) / inverse_spacing
    return distance, gx / length, gy / length, gz / length


@njit(cache=True, error_model="numpy")
@no_type_check
def _fill(table, low, inverse_spacing, points, distance, normal):
    for i in range(len(points)):
        distance[i], normal[i, 0], normal[i, 1], normal[i, 2] = table_distance(
            table, low, inverse_spacing, points[i, 0], points[i, 1], points[i, 2]
        )


class DistanceGrid:
    """Distance of `vessel` [m] on a cubic grid of `spacing` [m] that reaches `margin` [m] beyond the cavity.

    `table` [nx, ny, nz], `low` [3] and `inverse_spacing` [1/m] are what the compiled `table_distance` takes. Where the
    distance is linear (a plane wall) the table is exact; elsewhere it is off by up to spacing^2 / (8 radius), and
    by up to half a spacing on ridges.
    """

    def __init__(self, vessel: Vessel, spacing: float, margin: float = 0.015):
        if not (spacing > 0 and margin >= 0):
            raise OptionError("Spacing of a distance table must be positive and its margin not negative.")
        low, high = vessel.bounds()
        cells = np.ceil((high - low + 2.0 * margin) / spacing).astype(int)
        self.low: Float[np.ndarray, "3"] = low - margin
        self.low[:2] = -0.5 * spacing * cells[:2]  # as symmetric as the vessel
        self.inverse_spacing = 1.0 / spacing
        axes = [self.low[k] + spacing * np.arange(cells[k] + 1) for k in range(3)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self.table: Float[np.ndarray, "x y z"] = vessel.distance(points).reshape(*(cells + 1))

    def lookup(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
        """Distance [m], positive inside, and unit normal into the cavity at points [m]."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        distance, normal = np.empty(len(points)), np.empty((len(points), 3))
        _fill(self.table, self.low, self.inverse_spacing, points, distance, normal)
        return distance, normal
