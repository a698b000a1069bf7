"""The free surface of a liquid as heights over a polar grid that ends on the wall, also where the wall is sloped.

From particles: in columns through the cavity the share of the volume that is filled falls from one to zero at the
surface (as `zsdt.fluid.free_surface`, but with the distance to the wall at every height); a smooth polynomial through
all columns is carried on to the wall and moved up or down until it encloses the volume of the liquid.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float
from numpy.polynomial.polynomial import polyval2d

from zsdt.fluid.free_surface import LEVELS, SMOOTHING, fill_columns
from zsdt.fluid.kernel import plane_area, plane_beyond
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselShape

RINGS, ANGLES = 14, 72
FULL = 0.5  # weight of a column that is full up to the wall above it
REFITS = 4  # at most, until the columns that hold the surface are found
CLEAR = 0.2  # spacings from the wall within which a column says nothing about the surface
OUTWARD, BISECTIONS = 33, 24  # steps from the axis to the wall, and halvings of the one in which it is met

SurfaceFunction = Callable[[Float[np.ndarray, "places 2"]], Float[np.ndarray, " places"]]


def wall_radius(
    vessel: VesselShape, angle: Float[np.ndarray, "*places"], height: Float[np.ndarray, "*places"]
) -> Float[np.ndarray, "*places"]:
    """Distance [m] from the axis to the wall at angles [rad] from x to y and heights [m]."""
    along_x = np.interp(height, vessel.heights, vessel.radii)
    if vessel.is_round:
        return along_x
    n = vessel.exponent
    return along_x * (np.abs(np.cos(angle)) ** n + np.abs(np.sin(angle) / vessel.aspect) ** n) ** (-1.0 / n)


def polar_heights(
    vessel: VesselShape, surface: SurfaceFunction, rings: int = RINGS, angles: int = ANGLES
) -> Float[np.ndarray, "rings angles"]:
    """Heights [m] over the polar grid of `Glass.height` of a surface that is given over the plane.

    surface: height [m] at places (x, y) [m]. The contact line is where it meets the wall first on the way out from the
    axis; what it is beyond, as under the shoulder of a flask, does not count. It stays between floor and rim.
    """
    angle = 2.0 * np.pi * np.arange(angles) / angles
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def outside(radius: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
        flat = (radius[..., None] * ray).reshape(-1, 2)
        level = np.clip(surface(flat).reshape(radius.shape), 0.0, vessel.rim)
        return radius >= wall_radius(vessel, np.broadcast_to(angle, radius.shape), level)

    widest = wall_radius(vessel, angle, np.full(angles, vessel.heights[int(np.argmax(vessel.radii))]))
    steps = np.linspace(0.0, 1.0, OUTWARD)[:, None] * widest
    first = np.argmax(np.concatenate([outside(steps[:-1]), np.ones((1, angles), bool)]), axis=0)
    columns = np.arange(angles)
    low, high = steps[np.maximum(first - 1, 0), columns], steps[first, columns]
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        beyond = outside(middle[None])[0]
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    reach = 0.5 * (low + high)
    contact = np.clip(surface(reach[:, None] * ray), 0.0, vessel.rim)
    reach = wall_radius(vessel, angle, contact)
    shares = np.linspace(0.0, 1.0, rings)
    places = (shares[:, None, None] * reach[:, None] * ray).reshape(-1, 2)
    height = np.clip(surface(places).reshape(rings, angles), 0.0, vessel.rim)
    height[0] = height[0].mean()
    height[-1] = contact
    return height


def surface_points(
    vessel: VesselShape, height: Float[np.ndarray, "rings angles"]
) -> Float[np.ndarray, "rings angles 3"]:
    """Points [m] of a free surface in the axes of the vessel; those of the last ring lie on the wall."""
    rings, angles = height.shape
    angle = 2.0 * np.pi * np.arange(angles) / angles
    radius = np.linspace(0.0, 1.0, rings)[:, None] * wall_radius(vessel, angle, height[-1])
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)


def _lifted(surface: SurfaceFunction, lift: float) -> SurfaceFunction:
    return lambda places: surface(places) + lift


class VolumeBelow:
    """Volume [m3] of a vessel below a free surface given over its polar grid."""

    def __init__(self, vessel: VesselShape):
        self.vessel = vessel
        self._z = np.linspace(0.0, vessel.rim, 241)
        self._shares = (np.arange(40) + 0.5) / 40.0
        self._widest = max(vessel.radii)
        if vessel.is_round:
            # Length of the part below z of the vertical line at a radius that lies within the cavity.
            radius = np.interp(self._z, vessel.heights, vessel.radii)
            within = radius[None] > (self._shares * self._widest)[:, None]
            step = self._z[1]
            length = np.cumsum(0.5 * (within[:, 1:].astype(float) + within[:, :-1]), axis=1) * step
            self._length = np.concatenate([np.zeros((len(within), 1)), length], axis=1)

    def __call__(self, height: Float[np.ndarray, "rings angles"]) -> float:
        """The volume [m3] below `height` [m]."""
        rings, angles = height.shape
        angle = 2.0 * np.pi * np.arange(angles) / angles
        reach = wall_radius(self.vessel, angle, height[-1])
        if not self.vessel.is_round:
            shares = np.linspace(0.0, 1.0, rings)
            sums = np.trapezoid(shares[:, None] * height, shares, axis=0)
            # The trapezoidal rule over r^2 is exact to the square of the ring width for a flat surface.
            return float((sums * reach**2).sum() * 2.0 * np.pi / angles)
        radius = self._shares * self._widest
        total = 0.0
        weights = radius * (self._widest / len(radius)) * 2.0 * np.pi / angles
        for j in range(angles):
            level = np.interp(radius / reach[j], np.linspace(0.0, 1.0, rings), height[:, j])
            place = np.clip(level / self._z[1], 0.0, len(self._z) - 1.001)
            k = place.astype(int)
            part = place - k
            rows = np.arange(len(radius))
            total += float(weights @ ((1.0 - part) * self._length[rows, k] + part * self._length[rows, k + 1]))
        return total


class ParticleSurface:
    """Measures the free surface of particles `spacing` [m] apart in a vessel of any shape.

    volume [m3]: of the liquid, which the measured surface encloses exactly (None: as measured). degree: of the
    polynomial in x and y.
    """

    def __init__(self, vessel: VesselShape, spacing: float, volume: float | None = None, degree: int = 4):
        self.shape, self.vessel, self.spacing, self.volume, self.degree = (
            vessel,
            Vessel(vessel),
            spacing,
            volume,
            degree,
        )
        self.h = SMOOTHING * spacing
        self._scale = max(vessel.radii)
        self._step = spacing / LEVELS
        self._levels = self._step * np.arange(int(vessel.rim / self._step) + 1)
        grid = np.linspace(-0.98, 0.98, 17) * self._scale
        places = np.stack(np.meshgrid(grid, grid * vessel.aspect, indexing="ij"), axis=-1).reshape(-1, 2)
        distance = self._distances(places)
        inside = (distance > CLEAR * spacing).any(axis=1)
        self.columns = np.ascontiguousarray(places[inside])
        self._away = distance[inside]
        with np.errstate(divide="ignore"):
            gamma = 1.0 - plane_beyond(np.maximum(self._away, 0.0), self.h)
        self._weight = np.where(self._away > CLEAR * spacing, 1.0 / gamma, 0.0)
        offsets = np.linspace(0.0, 2.0 * self.h, 401)
        moment = offsets * plane_area(offsets, self.h)
        self._offsets = offsets
        self._moment = np.cumsum(moment[::-1])[::-1] * offsets[1]
        self._below = VolumeBelow(vessel)
        self._bias = np.zeros(RINGS)

    def calibrate(self, at_rest: Float[np.ndarray, "particles 3"]) -> None:
        """Takes what is measured too high or too low in each ring of a liquid at rest, whose surface is flat, off all
        that is measured later (near the wall kernels are cut off and particles lie in layers)."""
        self._bias = np.zeros(RINGS)
        height = self.measure(at_rest)
        volume = self._below(height) if self.volume is None else self.volume
        self._bias = height.mean(axis=1) - self.vessel.level(volume)

    def _distances(self, places: Float[np.ndarray, "columns 2"]) -> Float[np.ndarray, "columns levels"]:
        """Distance [m] to the wall alone (not the floor, near which no surface is looked for)."""
        count = len(self._levels)
        raised = np.maximum(self._levels, 3.0 * self.h)
        points = np.column_stack([np.repeat(places, count, axis=0), np.tile(raised, len(places))])
        return self.vessel.distance(points).reshape(len(places), count)

    def columns_heights(
        self, positions: Float[np.ndarray, "particles 3"]
    ) -> tuple[Float[np.ndarray, "found 2"], Float[np.ndarray, " found"], Bool[np.ndarray, " found"]]:
        """Places (x, y) [m] and heights [m] of the surface over the columns with liquid, and which of them are full:
        up to the wall above them (a shoulder), so that the surface is not there, and not lower than this height."""
        share = np.zeros((len(self.columns), len(self._levels)))
        given = np.ascontiguousarray(positions, np.float64)
        fill_columns(given, self.spacing**3, self.columns, self.h, self._step, share)
        share *= self._weight
        above = share >= 0.5
        last = share.shape[1] - 1 - np.argmax(above[:, ::-1], axis=1)
        rows = np.arange(len(share))
        next_one = np.minimum(last + 1, share.shape[1] - 1)
        here, beyond = share[rows, last], share[rows, next_one]
        found, full = above.any(axis=1), self._weight[rows, next_one] == 0
        height = self._step * (last + np.where(full, 1.0, (here - 0.5) / np.maximum(here - beyond, 1e-12)))
        away = self._away[rows, last]
        points = np.column_stack([self.columns, np.maximum(height, 3.0 * self.h)])
        normal = self.vessel.distance_and_normal(points)[1][:, :2]
        shift = np.interp(away, self._offsets, self._moment, right=0.0) * self._weight[rows, last]
        shift[full] = 0.0
        return (self.columns + shift[:, None] * normal)[found], height[found], full[found]

    def function(self, positions: Float[np.ndarray, "particles 3"]) -> SurfaceFunction:
        """The surface as a polynomial over the plane."""
        places, heights, full = self.columns_heights(positions)
        basis, trust, held = self._basis(places), np.where(full, FULL, 1.0), np.zeros(len(full), bool)
        for _ in range(REFITS):
            used = ~full | held
            # Fewer columns than terms, as in a vessel that is nearly empty, leave the highest terms at zero.
            weights = np.linalg.lstsq((basis * trust[:, None])[used], (heights * trust)[used], rcond=1e-6)[0]
            # A full column only says that the surface is not lower: it holds a fit that would fall below it.
            lower = full & (basis @ weights < heights)
            if np.array_equal(lower, held):
                break
            held = lower
        terms, scale = np.zeros((self.degree + 1, self.degree + 1)), self._scale
        for (a, b), weight in zip(self._powers, weights, strict=True):
            terms[a, b] = weight
        return lambda at: polyval2d(at[:, 0] / scale, at[:, 1] / scale, terms)

    @property
    def _powers(self) -> list[tuple[int, int]]:
        return [(a, b) for a in range(self.degree + 1) for b in range(self.degree + 1 - a)]

    def _basis(self, places: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, "places terms"]:
        x, y = places[:, 0] / self._scale, places[:, 1] / self._scale
        return np.stack([x**a * y**b for a, b in self._powers], axis=-1)

    def measure(
        self, positions: Float[np.ndarray, "particles 3"], rings: int = RINGS, angles: int = ANGLES
    ) -> Float[np.ndarray, "rings angles"]:
        """Heights [m] over the polar grid (see `polar_heights`)."""
        surface = self.function(positions)
        height = polar_heights(self.shape, surface, rings, angles)
        angle, lift = 2.0 * np.pi * np.arange(angles) / angles, 0.0
        if self.volume is not None:
            for _ in range(4):
                area = np.pi * self.shape.aspect * float(np.mean(wall_radius(self.shape, angle, height[-1]) ** 2))
                lift += (self.volume - self._below(height)) / area
                height = polar_heights(self.shape, _lifted(surface, lift), rings, angles)
        bias = np.interp(np.linspace(0.0, 1.0, rings), np.linspace(0.0, 1.0, RINGS), self._bias)
        return np.clip(height - bias[:, None], 0.0, self.shape.rim)
