"""What a wall does to a particle, as tables over the cavity: integrals of the kernel over the solid (DESIGN 3.2).

Every integral over the wall is a convolution of a kernel with the wall's indicator function, so any vessel whose
distance is known gets its table from a few fast Fourier transforms, corners included.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.fft import irfftn, next_fast_len, rfftn

from zsdt.errors import OptionError
from zsdt.fluid.kernel import SUPPORT, kernel, kernel_slope, plane_moment
from zsdt.fluid.vessel import Vessel

# columns of the table; symmetric tensors in the order xx yy zz xy xz yz
GAMMA, GRADIENT, SHEAR, SHEAR_DEPTH, LIFT, COLUMNS = 0, 1, 4, 10, 16, 19
_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@njit(cache=True, error_model="numpy")
@no_type_check
def table_row(table, low, inverse_spacing, x, y, z, row):
    """Trilinear values of all columns at a point into `row`; beyond the table those at its border."""
    fx, fy, fz = (x - low[0]) * inverse_spacing, (y - low[1]) * inverse_spacing, (z - low[2]) * inverse_spacing
    a = min(max(int(fx), 0), table.shape[0] - 2)
    b = min(max(int(fy), 0), table.shape[1] - 2)
    c = min(max(int(fz), 0), table.shape[2] - 2)
    fx, fy, fz = min(max(fx - a, 0.0), 1.0), min(max(fy - b, 0.0), 1.0), min(max(fz - c, 0.0), 1.0)
    for k in range(COLUMNS):
        row[k] = 0.0
    for i in range(2):
        wx = fx if i else 1.0 - fx
        for j in range(2):
            wy = wx * (fy if j else 1.0 - fy)
            for m in range(2):
                w = wy * (fz if m else 1.0 - fz)
                for k in range(COLUMNS):
                    row[k] += w * table[a + i, b + j, c + m, k]


@njit(cache=True, error_model="numpy")
@no_type_check
def table_lift_slope(table, low, inverse_spacing, x, y, z, slope):
    """slope[3 k + m] = d q_k / d x_m of the interpolated lift vector q, so that its forces have an exact potential."""
    fx, fy, fz = (x - low[0]) * inverse_spacing, (y - low[1]) * inverse_spacing, (z - low[2]) * inverse_spacing
    a = min(max(int(fx), 0), table.shape[0] - 2)
    b = min(max(int(fy), 0), table.shape[1] - 2)
    c = min(max(int(fz), 0), table.shape[2] - 2)
    fx, fy, fz = min(max(fx - a, 0.0), 1.0), min(max(fy - b, 0.0), 1.0), min(max(fz - c, 0.0), 1.0)
    for k in range(9):
        slope[k] = 0.0
    for i in range(2):
        wx, sx = (fx, inverse_spacing) if i else (1.0 - fx, -inverse_spacing)
        for j in range(2):
            wy, sy = (fy, inverse_spacing) if j else (1.0 - fy, -inverse_spacing)
            for m in range(2):
                wz, sz = (fz, inverse_spacing) if m else (1.0 - fz, -inverse_spacing)
                for k in range(3):
                    q = table[a + i, b + j, c + m, LIFT + k]
                    slope[3 * k] += sx * wy * wz * q
                    slope[3 * k + 1] += wx * sy * wz * q
                    slope[3 * k + 2] += wx * wy * sz * q


@njit(cache=True, error_model="numpy")
@no_type_check
def _fill_slopes(table, low, inverse_spacing, points, slopes):
    for i in range(len(points)):
        table_lift_slope(table, low, inverse_spacing, points[i, 0], points[i, 1], points[i, 2], slopes[i])


@njit(cache=True, error_model="numpy")
@no_type_check
def _fill(table, low, inverse_spacing, points, rows):
    for i in range(len(points)):
        table_row(table, low, inverse_spacing, points[i, 0], points[i, 1], points[i, 2], rows[i])


@njit(cache=True, error_model="numpy")
@no_type_check
def _sharpen(rough, table, columns):
    """table = rough less the mean error of linear interpolation in a cell, f'' a^2 / 12 along each axis: without it a
    lookup is right on average. All columns of a point side by side."""
    share, two = rough.dtype.type(1.0 / 12.0), rough.dtype.type(2.0)
    nx, ny, nz = rough.shape[0], rough.shape[1], rough.shape[2]
    for i in range(nx):
        for j in range(ny):
            for m in range(nz):
                for k in range(columns):
                    table[i, j, m, k] = rough[i, j, m, k]
                if 0 < i < nx - 1:
                    for k in range(columns):
                        bent = rough[i + 1, j, m, k] - two * rough[i, j, m, k] + rough[i - 1, j, m, k]
                        table[i, j, m, k] -= share * bent
                if 0 < j < ny - 1:
                    for k in range(columns):
                        bent = rough[i, j + 1, m, k] - two * rough[i, j, m, k] + rough[i, j - 1, m, k]
                        table[i, j, m, k] -= share * bent
                if 0 < m < nz - 1:
                    for k in range(columns):
                        bent = rough[i, j, m + 1, k] - two * rough[i, j, m, k] + rough[i, j, m - 1, k]
                        table[i, j, m, k] -= share * bent


class WallTables:
    """Kernel integrals over the wall of `vessel` for the smoothing length h [m], on a grid of h / `fineness`.

    `table` [nx, ny, nz, 19] float32, `low` [3] m and `inverse_spacing` [1/m] are what the compiled `table_row` takes:

    - GAMMA: gamma = 1 - int_wall W, the share of the kernel that lies in the cavity or above the rim;
    - GRADIENT: grad gamma [1/m], into the cavity;
    - SHEAR, SHEAR_DEPTH: tensors B [1/m2] and B1 [1/m] of the no-slip wall, `-10 W'/r  d d' / (r^2 + 0.01 h^2)` with
      d = x - x', the second weighted with the depth of x' in the wall: a wall particle moves as the mirror image that
      makes the velocity linear and zero at the wall, so the drag is `mu (B + B1 / distance) v` per volume;
    - LIFT: vector q [m]. A particle at rest at a wall misses the share n.M.n of the pressure gradient that balances
      its weight (M the first moment of grad W over the wall). The gradient of q is n (n.M.n) n' at a plane wall, so
      the force -m grad(g.q) makes up for it, and has the potential m g.q.

    gamma_only: leaves all columns but GAMMA and GRADIENT zero, which is enough for packing and a fraction of the work.

    Raises: OptionError where h or `fineness` is not positive.
    """

    def __init__(self, vessel: Vessel, h: float, fineness: float = 5.0, gamma_only: bool = False):
        if not (h > 0 and fineness > 0):
            raise OptionError(f"Wall tables need a positive smoothing length and fineness, not {h} and {fineness}.")
        self.h, self.spacing = h, h / fineness
        self.inverse_spacing = 1.0 / self.spacing
        axes = self._axes(vessel)
        self.low: Float[np.ndarray, "3"] = np.array([axis[0] for axis in axes])
        mesh = np.meshgrid(*axes, indexing="ij")
        distance = vessel.distance(np.stack(mesh, axis=-1).reshape(-1, 3)).reshape(mesh[0].shape)
        solid = np.clip(0.5 - distance / self.spacing, 0.0, 1.0)
        solid *= np.clip(0.5 + (vessel.rim - mesh[2]) / self.spacing, 0.0, 1.0)  # open above the rim
        self.table: Float[np.ndarray, "x y z columns"] = np.empty((*solid.shape, COLUMNS), np.float32)
        rough = np.zeros_like(self.table)
        self._convolve(rough, solid, None if gamma_only else np.maximum(-distance, 0.0) * solid)
        _sharpen(rough, self.table, SHEAR if gamma_only else COLUMNS)
        self.table[..., SHEAR if gamma_only else COLUMNS :] = 0.0

    def _axes(self, vessel: Vessel) -> list[np.ndarray]:
        """Grid points along each axis: symmetric about x = y = 0, one plane at z = 0, 2 h and two cells of margin."""
        low, high = vessel.bounds()
        margin = SUPPORT * self.h + 2.0 * self.spacing
        sides = [2 * math.ceil((high[k] + margin) / self.spacing) + 1 for k in range(2)]
        below = math.ceil((margin - low[2]) / self.spacing)
        first = [-(n // 2) for n in sides] + [-below]
        sides.append(below + math.ceil((high[2] + margin) / self.spacing) + 1)
        return [self.spacing * (start + np.arange(n)) for start, n in zip(first, sides, strict=True)]

    def _convolve(self, table: np.ndarray, solid: np.ndarray, depth: np.ndarray | None) -> None:
        """Fills the table by convolutions with the wall's indicator and with the depth below its surface (None: only
        the first columns)."""
        reach = math.ceil(SUPPORT * self.h / self.spacing)
        extra = (0, 0, reach)  # the floor must not come round to the open top; at the sides all is wall
        shape = [next_fast_len(n + more, real=True) for n, more in zip(solid.shape, extra, strict=True)]
        window = tuple(slice(n) for n in solid.shape)
        offset = np.meshgrid(*(np.fft.fftfreq(n, 1.0 / n) * self.spacing for n in shape), indexing="ij", sparse=True)
        r = np.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
        weight = kernel(r, self.h)
        unit = 1.0 / weight.sum()  # volume of a cell, corrected so that the discrete kernel sums to one
        slope = unit * kernel_slope(r, self.h)
        solid_hat = rfftn(solid, shape)

        def over(values: np.ndarray, what: np.ndarray) -> np.ndarray:
            return irfftn(rfftn(values) * what, shape)[window]

        table[..., GAMMA] = 1.0 - over(unit * weight, solid_hat)
        for k in range(3):
            table[..., GRADIENT + k] = -over(slope * offset[k], solid_hat)
        if depth is None:
            return
        depth_hat = rfftn(depth, shape)
        drag = -10.0 * slope / (r**2 + 0.01 * self.h**2)
        for c, (k, m) in enumerate(_SYMMETRIC):
            pair_hat = rfftn(drag * (offset[k] * offset[m]))
            table[..., SHEAR + c] = irfftn(pair_hat * solid_hat, shape)[window]
            table[..., SHEAR_DEPTH + c] = irfftn(pair_hat * depth_hat, shape)[window]
        lift = np.gradient(over(self._lift_kernel(r), solid_hat), self.spacing)
        for k in range(3):
            table[..., LIFT + k] = lift[k]

    def _lift_kernel(self, r: np.ndarray) -> np.ndarray:
        """Radial kernel whose integral over a half-space has the second derivative n.M.n: moment(r) / (2 pi r)."""
        reach = SUPPORT * self.h
        values = plane_moment(r, self.h) / (2.0 * math.pi * np.maximum(r, 0.5 * self.spacing))
        values[0, 0, 0] = 0.5 * 2.3800774 / (2.0 * math.pi * self.spacing)  # mean of 1/r over a cube
        fine = np.linspace(0.0, reach, 4001)
        whole = 2.0 * np.trapezoid(plane_moment(fine, self.h) * fine, fine)
        return values * (whole / values.sum())

    def rows(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points columns"]:
        """All columns at points [m]."""
        points = np.ascontiguousarray(points, np.float64)
        rows = np.empty((len(points), COLUMNS))
        _fill(self.table, self.low, self.inverse_spacing, points, rows)
        return rows

    def lift_slopes(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3 3"]:
        """Slopes d q_k / d x_m [-] of the lift vector at points [m]."""
        points = np.ascontiguousarray(points, np.float64)
        slopes = np.empty((len(points), 9))
        _fill_slopes(self.table, self.low, self.inverse_spacing, points, slopes)
        return slopes.reshape(-1, 3, 3)

    def gamma(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
        """Gamma [-] and its gradient [1/m] at points [m]: what packing needs."""
        rows = self.rows(points)
        return rows[:, GAMMA], rows[:, GRADIENT : GRADIENT + 3]
