"""Particles that fill a vessel evenly: a Poisson-disk start, packed by the kernel's own measure of evenness.

The same steps serve a simulation and the twin, whose points come from a picture: `pack` takes any points, and
`spacing_of` says which spacing their number stands for (points drawn at radius r are ~1.2 r apart; DESIGN 3.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from zsdt.errors import OptionError, RunRejected
from zsdt.fluid.kernel import SUPPORT, plane_area, slope_factor
from zsdt.fluid.vessel import Vessel
from zsdt.fluid.wall_tables import WallTables
from zsdt.radius_graph import RadiusGraph

DISK_SHARE = 0.85  # radius of the disks over the spacing that their number comes to
SMOOTHING = 1.5  # smoothing length over spacing (DESIGN 3.2)
STRIDE = 0.15  # packing moves a particle by this times -h^2 sum V grad W
LONGEST = 0.1  # spacings that it moves at most in one step
CLEAR = 0.3  # spacings that it stays away from wall, floor and surface


@dataclass(frozen=True)
class Filling:
    """Packed particles of one volume each: points [particles, 3] m, spacing [m], total volume [m3], wall tables."""

    points: Float[np.ndarray, "particles 3"]
    spacing: float
    volume: float
    tables: WallTables


def spacing_of(volume: float, particles: int) -> float:
    """Spacing [m] of `particles` particles that share a volume [m3]: the cube root of what each has."""
    if particles < 1 or volume <= 0:
        raise OptionError(f"{particles} particles in {volume} m3 have no spacing; both must be positive.")
    return float((volume / particles) ** (1.0 / 3.0))


@njit(cache=True, error_model="numpy")
@no_type_check
def _throw_darts(candidates, radius, low, first, kept):
    """Keeps candidates in turn if none kept before is nearer than `radius`; `first` [cells] is -1 where empty."""
    cell = radius / math.sqrt(3.0)  # holds one point at most
    count, nx, ny, nz = 0, *first.shape
    for q in range(len(candidates)):
        x, y, z = candidates[q]
        a, b, c = int((x - low[0]) / cell), int((y - low[1]) / cell), int((z - low[2]) / cell)
        free = True
        for i in range(max(a - 2, 0), min(a + 3, nx)):
            for j in range(max(b - 2, 0), min(b + 3, ny)):
                for k in range(max(c - 2, 0), min(c + 3, nz)):
                    p = first[i, j, k]
                    if p >= 0 and free:
                        dx, dy, dz = x - kept[p, 0], y - kept[p, 1], z - kept[p, 2]
                        free = dx * dx + dy * dy + dz * dz >= radius * radius
        if free:
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            first[a, b, c] = count
            count += 1
    return count


def poisson_disk(
    vessel: Vessel, level: float, radius: float, margin: float, rng: np.random.Generator
) -> Float[np.ndarray, "points 3"]:
    """Random points [m] of the cavity below `level` [m], none two nearer than `radius` [m], by dart throwing.

    They stay `margin` [m] away from the wall and from the level.
    """
    low, high = vessel.bounds()
    high = np.array([high[0], high[1], level])
    count = int(60.0 * np.prod(high - low) / radius**3)  # the last darts hardly ever find a place
    candidates = low + rng.random((count, 3)) * (high - low)
    candidates = candidates[candidates[:, 2] < level - margin]
    candidates = candidates[vessel.distance(candidates) > margin]
    cells = np.ceil((high - low) / (radius / math.sqrt(3.0))).astype(np.int64) + 1
    kept = np.empty_like(candidates)
    found = _throw_darts(candidates, radius, low, np.full(tuple(cells), -1, np.int64), kept)
    return kept[:found].copy()


@njit(cache=True, error_model="numpy")
@no_type_check
def _kernel_gradients(points, offset, neighbour, h, volume, out):
    """out[i] = sum over neighbours of V grad W."""
    factor = volume * slope_factor(h)
    for i in range(len(points)):
        gx, gy, gz = 0.0, 0.0, 0.0
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
            t = max(1.0 - 0.5 * math.sqrt(dx * dx + dy * dy + dz * dz) / h, 0.0)
            f = factor * t * t * t
            gx, gy, gz = gx + f * dx, gy + f * dy, gz + f * dz
        out[i, 0], out[i, 1], out[i, 2] = gx, gy, gz


class Packer:
    """Moves particles to where the kernel sees an even filling of the cavity below a level.

    Each step is `dx = -0.15 h^2 sum V grad W`, the wall's and a lid's share of the sum included: wall by its tables
    (DESIGN 3.2), lid as the plane z = level.
    """

    def __init__(self, vessel: Vessel, level: float, spacing: float, tables: WallTables | None = None):
        self.vessel, self.level, self.spacing = vessel, level, spacing
        self.tables = tables or WallTables(vessel, SMOOTHING * spacing)
        self.h = self.tables.h
        self._graph = RadiusGraph(SUPPORT * self.h, 0.3 * self.h)

    def unevenness(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """`sum V grad W` over neighbours, wall and lid [1/m]: zero where a filling is even."""
        self._graph.update(points)
        total = np.empty_like(points)
        _kernel_gradients(points, self._graph.offset, self._graph.neighbour, self.h, self.spacing**3, total)
        total -= self.tables.gamma(points)[1]
        total[:, 2] += plane_area(self.level - points[:, 2], self.h)
        return total

    def pack(self, points: Float[np.ndarray, "points 3"], iterations: int = 150) -> Float[np.ndarray, "points 3"]:
        """The points [m] after `iterations` steps."""
        points = np.ascontiguousarray(points, np.float64).copy()
        for _ in range(iterations):
            step = -STRIDE * self.h**2 * self.unevenness(points)
            length = np.linalg.norm(step, axis=1, keepdims=True)
            points += step * np.minimum(1.0, LONGEST * self.spacing / (length + 1e-300))
            self._keep_clear(points)
        return points

    def _keep_clear(self, points: Float[np.ndarray, "points 3"]) -> None:
        """Moves points that are too near to wall or surface, in place."""
        distance, normal = self.vessel.distance_and_normal(points)
        points += np.maximum(CLEAR * self.spacing - distance, 0.0)[:, None] * normal
        np.minimum(points[:, 2], self.level - CLEAR * self.spacing, out=points[:, 2])


def fill(
    vessel: Vessel,
    level: float,
    particles: int,
    rng: np.random.Generator,
    smoothing: float = SMOOTHING,
    fineness: float = 5.0,
) -> Filling:
    """About `particles` packed particles (within some 5 %) in the vessel below `level` [m].

    smoothing: smoothing length over spacing; fineness of the wall tables (both as the solver wants them).

    Raises: RunRejected ("packing") where the vessel is too small for that many.
    """
    volume = vessel.volume(level)
    wanted = spacing_of(volume, particles)
    start = poisson_disk(vessel, level, DISK_SHARE * wanted, 0.25 * wanted, rng)
    if len(start) < 0.5 * particles:
        raise RunRejected(
            "packing", f"Only {len(start)} of {particles} particles find a place in the vessel; ask for more or fewer."
        )
    spacing = spacing_of(volume, len(start))
    packer = Packer(vessel, level, spacing, WallTables(vessel, smoothing * spacing, fineness))
    return Filling(packer.pack(start), spacing, volume, packer.tables)
