"""The free surface of particles as a smooth function of place, in a vessel of any shape.

Columns stand in the cavity. In each the share of the kernel that is filled, over the share that is cavity, falls from
one to zero at the surface; where it crosses one half from above is the height there (`zsdt.fluid.free_surface`, here
with walls that lean). A polynomial in x and y, even in y because the vessel is moved along x, goes through all columns:
it is finer than a particle and reaches the wall, where a camera sees the surface.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, no_type_check

import numba
import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.fluid.kernel import plane_area, plane_beyond
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily, VesselShape
from zsdt.trajectory import Body

DEGREE, FINE_DEGREE = 3, 4  # of the polynomial, and of one that also shows what stands out between the walls
SMOOTHING = 1.2  # smoothing length over particle spacing
LAYERS = 4  # heights per spacing at which a column is looked at
RINGS, AROUND = (0.0, 0.3, 0.5, 0.68, 0.84, 0.97), 18  # shares of the half-width, places around: of columns
NEAR, LEAST_TRUST = 1.0, 0.03  # spacings from the wall, nearer than which particles are uneven; trust at the wall
CLOSED = 0.3  # how far a column is trusted that is full up to a wall which leans over it
LEAST_CAVITY = 0.3  # share of the kernel in the cavity, below which a height of a column is wall
RIDGE = 1e-3  # of the mean diagonal: terms that a surface of few columns cannot tell apart
_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True, fastmath=True)


@_jit
@no_type_check
def _surface(positions, volume, columns, cavity, h, step, share, height, trust):
    """Heights [columns] m of the surface, -1 where a column is dry, and `trust` of them; `share` is scratch."""
    scale = 21.0 / (16.0 * np.pi * h**3) * volume
    reach, inverse = 4.0 * h * h, 1.0 / step
    share[:] = 0.0
    for j in range(len(positions)):
        x, y, z = positions[j, 0], positions[j, 1], positions[j, 2]
        for c in range(len(columns)):
            dx, dy = columns[c, 0] - x, columns[c, 1] - y
            flat = dx * dx + dy * dy
            if flat >= reach:
                continue
            half = np.sqrt(reach - flat)
            first = max(int(np.ceil((z - half) * inverse)), 0)
            last = min(int(np.floor((z + half) * inverse)), share.shape[1] - 1)
            for k in range(first, last + 1):
                dz = k * step - z
                q = np.sqrt(flat + dz * dz) / h
                t = 1.0 - 0.5 * q
                share[c, k] += scale * t * t * t * t * (2.0 * q + 1.0)
    for c in range(len(columns)):
        height[c] = -1.0
        above, closed = 0.0, True
        for k in range(share.shape[1] - 1, -1, -1):
            if cavity[c, k] < LEAST_CAVITY:
                above, closed = 0.0, True
                continue
            here = share[c, k] / cavity[c, k]
            if here >= 0.5:
                height[c] = step * (k + (here - 0.5) / max(here - above, 1e-9))
                trust[c] = CLOSED if closed else 1.0
                break
            above, closed = here, False


class LevelReader:
    """Reads the surface of particles `spacing` [m] apart in one vessel.

    Raises: OptionError where the vessel is too narrow for the spacing.
    """

    def __init__(self, shape: VesselShape, spacing: float, degree: int = DEGREE):
        self.spacing, self.h, self.step = spacing, SMOOTHING * spacing, spacing / LAYERS
        self.powers = np.array([(a, b) for b in range(0, degree + 1, 2) for a in range(degree + 1 - b)])
        self.scale = float(np.max(shape.radii))
        vessel = Vessel(shape)
        self.columns, self.area = _columns(shape)
        self.heights = self.step * np.arange(int((shape.rim + 4.0 * spacing) / self.step))
        points = np.concatenate(
            [
                np.repeat(self.columns, len(self.heights), axis=0),
                np.tile(np.maximum(self.heights, 2.0 * self.h), len(self.columns))[:, None],
            ],
            axis=1,
        )
        away, normal = vessel.distance_and_normal(points)
        grid = (len(self.columns), len(self.heights))
        self.cavity = (1.0 - plane_beyond(away, self.h)).reshape(grid)
        self.inside = np.clip(away / (NEAR * spacing), 0.0, 1.0).reshape(grid) ** 2 + LEAST_TRUST
        # The sum is one-sided near a wall: it tells the height a little away from it.
        offsets = np.linspace(0.0, 2.0 * self.h, 401)
        beyond = np.cumsum((offsets * plane_area(offsets, self.h))[::-1])[::-1] * offsets[1]
        shift = np.interp(away, offsets, beyond, right=0.0) / np.maximum(1.0 - plane_beyond(away, self.h), 0.3)
        self.shift = (shift[:, None] * normal[:, :2]).reshape(*grid, 2)
        self.scratch = np.empty(grid)
        self.fine, self.fine_area, self.bottom, self.ceiling = _cells(shape)
        self.fine_terms = self.terms(self.fine)
        if len(self.columns) < 2 * len(self.powers):
            raise OptionError("The vessel is too narrow to measure its surface; take more particles.")

    def terms(self, places: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, "places terms"]:
        """Terms of the polynomial at places (x, y) [m]."""
        along, aside = self._powers(places)
        return along[:, self.powers[:, 0]] * aside[:, self.powers[:, 1]]

    def slopes(self, places: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, "places 2 terms"]:
        """Derivatives of the terms by x and y [1/m]."""
        along, aside = self._powers(places)
        a, b = self.powers.T
        by_x = a * along[:, np.maximum(a - 1, 0)] * aside[:, b]
        by_y = b * aside[:, np.maximum(b - 1, 0)] * along[:, a]
        return np.stack([by_x, by_y], axis=1) / self.scale

    def _powers(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        powers = np.empty((2, len(places), int(self.powers.max()) + 1))
        powers[..., 0] = 1.0
        powers[..., 1:] = (places.T / self.scale)[..., None]
        np.multiply.accumulate(powers, axis=2, out=powers)  # a third of the time that `**` takes
        return powers[0], powers[1]

    def volume(self, coefficients: Float[np.ndarray, " terms"]) -> tuple[float, float]:
        """Volume [m3] of the cavity below a surface, and by how much it grows per height [m2]."""
        height = self.fine_terms @ coefficients
        held = np.clip(height, self.bottom, self.ceiling) - self.bottom
        free = (height > self.bottom) & (height < self.ceiling)
        return float(self.fine_area @ held), float(self.fine_area[free].sum())

    def holding(self, coefficients: Float[np.ndarray, " terms"], volume: float) -> Float[np.ndarray, " terms"]:
        """The same surface, raised or lowered until it holds `volume` [m3]: kernels tell its height with a bias of a
        tenth of a spacing, and the amount of liquid is known."""
        found = coefficients.copy()
        for _ in range(3):
            held, growth = self.volume(found)
            found[0] += (volume - held) / max(growth, 0.1 * float(self.fine_area.sum()))
        return found

    def fit(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " terms"]:
        """Coefficients [m] of the surface of particles at `positions` [m]."""
        return self.through(*self.read(positions))

    def read(
        self, positions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "wet 2"], Float[np.ndarray, " wet"], Float[np.ndarray, " wet"]]:
        """Places (x, y) [m] of columns with liquid, heights [m] of their surface, and how far they are trusted."""
        height, trust = np.empty(len(self.columns)), np.ones(len(self.columns))
        _surface(
            np.ascontiguousarray(positions, np.float64), self.spacing**3, self.columns, self.cavity, self.h, self.step,
            self.scratch, height, trust,
        )  # fmt: skip
        wet = height >= 0.0
        layer = np.clip(np.rint(height / self.step).astype(np.int64), 0, len(self.heights) - 1)
        places = self.columns + self.shift[np.arange(len(layer)), layer]
        trust *= self.inside[np.arange(len(layer)), layer]
        return places[wet], height[wet], trust[wet]

    def through(
        self, places: Float[np.ndarray, "wet 2"], height: Float[np.ndarray, " wet"], trust: Float[np.ndarray, " wet"]
    ) -> Float[np.ndarray, " terms"]:
        """Coefficients [m] of the surface through columns."""
        if len(height) < len(self.powers):
            return np.zeros(len(self.powers))
        rows = self.terms(places)
        right = rows.T * trust
        square = right @ rows
        square[np.diag_indices_from(square)] += RIDGE * np.trace(square) / len(square) * (self.powers.sum(axis=1) > 0)
        return np.linalg.solve(square, right @ height)

    def at(
        self, coefficients: Float[np.ndarray, " terms"], places: Float[np.ndarray, "places 2"]
    ) -> Float[np.ndarray, " places"]:
        """Heights [m] at places (x, y) [m]."""
        return self.terms(places) @ coefficients


def _columns(shape: VesselShape) -> tuple[Float[np.ndarray, "columns 2"], Float[np.ndarray, " columns"]]:
    """Places [m] of columns over the widest cross-section, and the areas [m2] around them."""
    angle = (np.arange(AROUND) + 0.5) * 2 * np.pi / AROUND
    middle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    turn = np.full(AROUND, 2 * np.pi / AROUND)
    if not shape.is_round:
        reach = (np.abs(middle) ** shape.exponent).sum(axis=1) ** (-1.0 / shape.exponent)
        middle, turn = reach[:, None] * middle * [1.0, shape.aspect], reach**2 * shape.aspect * turn
    widest, rings = float(np.max(shape.radii)), np.array(RINGS)
    bounds = np.concatenate([[0.0], 0.5 * (rings[1:] + rings[:-1]), [1.0]]) ** 2
    areas = widest**2 * 0.5 * np.diff(bounds)[:, None] * turn
    places = (widest * rings[1:, None, None] * middle).reshape(-1, 2)
    centre = np.array([[0.0, 0.0]])
    return np.concatenate([centre, places]), np.append(areas[0].sum(), areas[1:].ravel())


def _cells(shape: VesselShape) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places [m] and areas [m2] of fine columns over the widest cross-section, and the heights [m] of the wall below
    and above each."""
    angle = (np.arange(16) + 0.5) * np.pi / 8
    middle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    turn = np.full(16, np.pi / 8)
    if not shape.is_round:
        angle = (np.arange(256) + 0.5) * np.pi / 128
        middle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        reach = (np.abs(middle) ** shape.exponent).sum(axis=1) ** (-1.0 / shape.exponent)
        middle, turn = reach[:, None] * middle * [1.0, shape.aspect], reach**2 * shape.aspect * np.pi / 128
    widest = float(np.max(shape.radii))
    node, weight = np.polynomial.legendre.leggauss(16)
    share, weight = 0.5 * (node + 1.0), 0.5 * weight
    places = (widest * share[:, None, None] * middle).reshape(-1, 2)
    areas = (widest**2 * (share * weight)[:, None] * turn).ravel()
    bottom, ceiling = np.zeros(len(places)), np.full(len(places), shape.rim + widest)
    if shape.is_round:
        heights = np.linspace(0.0, shape.rim, 2000)
        radii = np.interp(heights, shape.heights, shape.radii)
        top = int(np.argmax(radii))
        distance = np.hypot(*places.T)
        bottom = np.interp(distance, np.maximum.accumulate(radii[: top + 1]), heights[: top + 1], left=0.0)
        after = np.minimum.accumulate(radii[top:])[::-1]
        ceiling = np.where(distance < after[0], ceiling, np.interp(distance, after, heights[top:][::-1]))
    return places, areas, bottom, ceiling


@lru_cache(maxsize=8)
def _reader(
    spacing: float, degree: int, family: str, heights: tuple, radii: tuple, aspect: float, exponent: float
) -> LevelReader:
    return LevelReader(VesselShape(VesselFamily(family), list(heights), list(radii), aspect, exponent), spacing, degree)


def reader_of(shape: VesselShape, spacing: float, degree: int = DEGREE) -> LevelReader:
    """The reader of a vessel and a spacing [m], made once."""
    return _reader(
        spacing, degree, shape.family.value, tuple(shape.heights), tuple(shape.radii), shape.aspect, shape.exponent
    )


def surface_heights(
    body: Body, positions: Float[np.ndarray, "nodes 3"], places: Float[np.ndarray, "places 2"]
) -> Float[np.ndarray, " places"]:
    """Heights [m] of the free surface of a liquid's particles at `positions` [m] over `places` (x, y) [m].

    Raises: OptionError where the body is no liquid in a vessel.
    """
    if body.vessel is None or body.liquid is None:
        raise OptionError("Only a liquid in a vessel has a free surface.")
    reader = reader_of(body.vessel, body.pitch)
    volume = float(body.mass.sum()) / body.liquid.density
    return reader.at(reader.holding(reader.fit(positions), volume), places)
