"""Height of the free surface from particles, finer than a particle, and its highest point as a camera sees it.

Columns stand on a disc (or any outline) inside the vessel. In each the share of the volume that is filled,
`sum_j V_j W(x - x_j) / gamma(x)`, falls from one to zero at the surface; where it crosses one half from above is the
height there. A single drop fills less than a quarter and is not seen. The sum is one-sided near the wall and so tells
the height a little away from it: a smooth polynomial in x and y through all columns gives it at the wall itself.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from zsdt.errors import OptionError
from zsdt.fluid.kernel import plane_area, plane_beyond
from zsdt.fluid.vessel import Vessel

SMOOTHING = 1.2  # smoothing length over particle spacing
LEVELS = 4  # heights per spacing at which a column is filled
_jit: Any = njit(cache=True, error_model="numpy")


@_jit
@no_type_check
def fill_columns(positions, volume, columns, h, step, share):
    """Filled volume [-] of the columns at heights of `step`, without the correction for the wall."""
    scale = 21.0 / (16.0 * np.pi * h**3)
    reach = 4.0 * h * h
    for j in range(len(positions)):
        x, y, z = positions[j]
        for c in range(len(columns)):
            flat = (columns[c, 0] - x) ** 2 + (columns[c, 1] - y) ** 2
            if flat >= reach:
                continue
            half = np.sqrt(reach - flat)
            first = max(int(np.ceil((z - half) / step)), 0)
            last = min(int(np.floor((z + half) / step)), share.shape[1] - 1)
            for k in range(first, last + 1):
                q = np.sqrt(flat + (k * step - z) ** 2) / h
                t = max(1.0 - 0.5 * q, 0.0)
                share[c, k] += volume * scale * t**4 * (2.0 * q + 1.0)


class FreeSurface:
    """Measures the surface of a liquid of particles `spacing` [m] apart in a vessel with upright walls.

    level: rest level [m], about which the columns are placed. The polynomial has the degree `degree`.
    Raises: OptionError where the vessel is too narrow for the spacing.
    """

    def __init__(self, vessel: Vessel, spacing: float, level: float, degree: int = 3):
        self.spacing, self.degree = spacing, degree
        self.h = SMOOTHING * spacing
        low, high = vessel.bounds()
        self.top = float(high[2])
        reach = np.maximum(np.abs(low[:2]), np.abs(high[:2]))
        grid = np.linspace(-1.0, 1.0, 17)
        square = np.stack(np.meshgrid(grid * reach[0], grid * reach[1], indexing="ij"), axis=-1).reshape(-1, 2)
        rim = _rim(vessel, level, 96)
        candidates = np.concatenate([square, 0.999 * rim[::2]])
        away = vessel.distance(np.column_stack([candidates, np.full(len(candidates), max(level, 3.0 * self.h))]))
        self.columns, away = candidates[away > 0], away[away > 0]
        self.rim = rim
        terms = len(self._basis(np.zeros((1, 2)), 1.0)[0])
        if len(self.columns) < 2 * terms:
            raise OptionError("The vessel is too narrow to measure its surface; take a smaller spacing.")
        self.gamma = 1.0 - plane_beyond(away, self.h)
        self.scale = float(reach.max())
        shift = _one_sided_shift(away, self.h, self.gamma)
        inward = _inward(vessel, self.columns, max(level, 3.0 * self.h))
        self.centres = self.columns + shift[:, None] * inward
        self._solve = np.linalg.pinv(self._basis(self.centres, self.scale))

    def _basis(self, points: np.ndarray, scale: float) -> np.ndarray:
        x, y = points[:, 0] / scale, points[:, 1] / scale
        return np.stack([x**a * y**b for a in range(self.degree + 1) for b in range(self.degree + 1 - a)], axis=-1)

    def columns_heights(self, positions: Float[np.ndarray, "particles 3"]) -> Float[np.ndarray, " columns"]:
        """Height of the surface [m] over each column; 0 where a column is dry."""
        step = self.spacing / LEVELS
        share = np.zeros((len(self.columns), int(self.top / step) + 4 * LEVELS))
        fill_columns(np.ascontiguousarray(positions, np.float64), self.spacing**3, self.columns, self.h, step, share)
        share /= self.gamma[:, None]
        above = share >= 0.5
        last = share.shape[1] - 1 - np.argmax(above[:, ::-1], axis=1)
        last = np.minimum(last, share.shape[1] - 2)
        rows = np.arange(len(share))
        here, beyond = share[rows, last], share[rows, last + 1]
        height = step * (last + (here - 0.5) / np.maximum(here - beyond, 1e-12))
        return np.where(above.any(axis=1), height, 0.0)

    def at(
        self, positions: Float[np.ndarray, "particles 3"], places: Float[np.ndarray, "places 2"]
    ) -> Float[np.ndarray, " places"]:
        """Height of the surface [m] at `places` (x, y) [m], from the polynomial."""
        return self._basis(places, self.scale) @ (self._solve @ self.columns_heights(positions))

    def highest(self, positions: Float[np.ndarray, "particles 3"]) -> float:
        """Height of the highest point of the surface [m]: on the wall or over a column."""
        return float(self.at(positions, np.concatenate([self.rim, self.columns])).max())


def _rim(vessel: Vessel, level: float, count: int) -> np.ndarray:
    """Points (x, y) where rays from the axis meet the wall at the height `level`."""
    angle = 2.0 * np.pi * np.arange(count) / count
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    low, high = np.zeros(count), np.full(count, 2.0 * float(np.abs(np.concatenate(vessel.bounds())).max()))
    for _ in range(50):
        middle = 0.5 * (low + high)
        inside = vessel.distance(np.column_stack([middle[:, None] * ray, np.full(count, level)])) > 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return low[:, None] * ray


def _inward(vessel: Vessel, places: np.ndarray, level: float) -> np.ndarray:
    normal = vessel.distance_and_normal(np.column_stack([places, np.full(len(places), level)]))[1][:, :2]
    return normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]


def _one_sided_shift(away: np.ndarray, h: float, gamma: np.ndarray) -> np.ndarray:
    """Distance of the kernel's centre of mass from its centre, where a plane wall cuts it off."""
    offsets = np.linspace(0.0, 2.0 * h, 401)
    weight = offsets * plane_area(offsets, h)
    beyond = np.concatenate([np.cumsum(weight[::-1])[::-1]]) * offsets[1]
    return np.interp(away, offsets, beyond, right=0.0) / gamma
