"""Cavity of a vessel: exact distance to its wall, wall normal, volume and fill level.

Both kinds of vessels reduce to a line in a plane that a point is folded into: a body of revolution to its profile
in (r, z), a prism to a quarter of its cross-section in (|x|, |y|).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from zsdt.errors import OptionError
from zsdt.scene import VesselShape

QUARTER_EDGES = 128  # of the polygon that stands for a superellipse: area exact to 3e-5
ABOVE = 1.0  # m of wall that is thought above the rim


@njit(cache=True, error_model="numpy")
@no_type_check
def _nearest(u, v, line):
    """Signed distance of (u, v) to a line whose second coordinate never falls, and its gradient; inside is left."""
    best, cu, cv, tu, tv = 1e30, 0.0, 0.0, 0.0, 1.0
    inside = False
    for k in range(len(line) - 1):
        u1, v1 = line[k, 0], line[k, 1]
        du, dv = line[k + 1, 0] - u1, line[k + 1, 1] - v1
        s = ((u - u1) * du + (v - v1) * dv) / (du * du + dv * dv)
        s = min(max(s, 0.0), 1.0)
        pu, pv = u1 + s * du, v1 + s * dv
        d = (u - pu) ** 2 + (v - pv) ** 2
        if d < best:
            best, cu, cv, tu, tv = d, pu, pv, du, dv
        if v1 <= v < v1 + dv:
            inside = u < u1 + (v - v1) / dv * du
    d = math.sqrt(best)
    if d < 1e-9:  # on the wall: the normal of the nearest piece
        length = math.sqrt(tu * tu + tv * tv)
        return (d if inside else -d), -tv / length, tu / length
    sign = 1.0 if inside else -1.0
    return sign * d, sign * (u - cu) / d, sign * (v - cv) / d


@njit(cache=True, error_model="numpy")
@no_type_check
def _fill_round(points, line, distance, normal):
    """Distance and normal of a body of revolution with the profile `line` in (r, z), the floor included."""
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        r = math.sqrt(x * x + y * y)
        distance[i], nr, nz = _nearest(r, points[i, 2], line)
        if r > 1e-12:
            normal[i, 0], normal[i, 1], normal[i, 2] = nr * x / r, nr * y / r, nz
        else:
            normal[i, 0], normal[i, 1], normal[i, 2] = nr, 0.0, nz


@njit(cache=True, error_model="numpy")
@no_type_check
def _fill_prism(points, line, distance, normal):
    """Distance and normal of a prism on the floor z = 0; `line` is the quarter of its cross-section with x, y >= 0."""
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        side, nx, ny = _nearest(abs(x), abs(y), line)
        nx, ny, nz = (-nx if x < 0.0 else nx), (-ny if y < 0.0 else ny), 0.0
        if side < 0.0 and z < 0.0:  # outside of both: the edge of the floor is nearest
            away = math.sqrt(side * side + z * z)
            distance[i] = -away
            nx, ny, nz = -side / away * nx, -side / away * ny, -z / away
        elif z < side:
            distance[i] = z
            nx, ny, nz = 0.0, 0.0, 1.0
        else:
            distance[i] = side
        normal[i, 0], normal[i, 1], normal[i, 2] = nx, ny, nz


def _superellipse_quarter(half_x: float, half_y: float, exponent: float) -> Float[np.ndarray, "points 2"]:
    """Points of `|x/a|^n + |y/b|^n = 1` from (a, 0) to (0, b), at even angles of a circle squeezed into the box."""
    angle = np.linspace(0.0, 0.5 * np.pi, QUARTER_EDGES + 1)
    cos, sin = np.cos(angle), np.sin(angle)
    cos[-1] = sin[0] = 0.0
    reach = (cos**exponent + sin**exponent) ** (-1.0 / exponent)
    return np.stack([half_x * reach * cos, half_y * reach * sin], axis=1)


class Vessel:
    """The cavity of a `VesselShape`: floor at z = 0, axis at x = y = 0, open at the rim.

    Distances [m] are positive inside the cavity and negative in and beyond the wall; normals are their gradient and
    point into the cavity. Above the rim the wall is continued upwards, so that a splash is told apart from a leak by
    its height. Distances of round vessels are exact; a superellipse is a polygon of 512 edges (within 5e-6 m).
    """

    def __init__(self, shape: VesselShape):
        self.shape = shape
        heights, radii = np.array(shape.heights), np.array(shape.radii)
        self._heights, self._radii = heights, radii
        if shape.is_round:
            wall = np.stack([radii, heights], axis=1)
            self._line = np.concatenate([[[0.0, 0.0]], wall, [[radii[-1], shape.rim + ABOVE]]])
        else:
            self._line = _superellipse_quarter(radii[0], radii[0] * shape.aspect, shape.exponent)
        below = math.pi / 3.0 * np.diff(heights) * (radii[1:] ** 2 + radii[1:] * radii[:-1] + radii[:-1] ** 2)
        self._volume_to = np.concatenate([[0.0], np.cumsum(below)])

    @property
    def rim(self) -> float:
        """Height of the rim [m]."""
        return self.shape.rim

    def distance(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Distance to wall and floor [m] of points [m], positive inside."""
        return self.distance_and_normal(points)[0]

    def distance_and_normal(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
        """Distance [m] and its gradient (of length one, into the cavity) at points [m]."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        distance, normal = np.empty(len(points)), np.empty((len(points), 3))
        (_fill_round if self.shape.is_round else _fill_prism)(points, self._line, distance, normal)
        return distance, normal

    def radius(self, height: Float[np.ndarray, " points"] | float) -> Float[np.ndarray, " points"] | float:
        """Half-width along x [m] at heights [m]; that of the rim above it, that of the floor below it."""
        found = np.interp(height, self._heights, self._radii)
        return float(found) if np.ndim(found) == 0 else found

    @property
    def base_area(self) -> float:
        """Area of the cross-section of a prism, of the floor of a round vessel [m2]."""
        if self.shape.is_round:
            return math.pi * float(self._radii[0]) ** 2
        x, y = self._line.T
        return 2.0 * float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))

    def volume(self, level: float) -> float:
        """Volume [m3] below the height `level` [m]; above the rim the wall is continued."""
        level = max(level, 0.0)
        if not self.shape.is_round:
            return self.base_area * level
        inside = min(level, self.rim)
        k = int(np.clip(np.searchsorted(self._heights, inside, side="right") - 1, 0, len(self._heights) - 2))
        low, r1, r2 = self._heights[k], self._radii[k], float(self.radius(inside))
        frustum = math.pi / 3.0 * (inside - low) * (r1 * r1 + r1 * r2 + r2 * r2)
        return float(self._volume_to[k] + frustum + math.pi * self._radii[-1] ** 2 * (level - inside))

    def level(self, volume: float) -> float:
        """Height [m] up to which a volume [m3] at rest fills the vessel.

        Raises: OptionError for a negative volume.
        """
        if volume < 0.0:
            raise OptionError(f"A liquid cannot have the negative volume {volume} m3.")
        low, high = 0.0, self.rim
        while self.volume(high) < volume:
            low, high = high, 2.0 * high
        for _ in range(200):
            middle = 0.5 * (low + high)
            if middle in (low, high):
                break
            low, high = (middle, high) if self.volume(middle) < volume else (low, middle)
        return 0.5 * (low + high)

    def bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Lowest and highest corner [m] of the box around the cavity."""
        half = np.array([self._radii.max(), self._radii.max() * self.shape.aspect])
        return np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], self.rim])
