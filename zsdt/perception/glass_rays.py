"""Lines of sight through the wall of a glass: where a pixel meets the near and the far side of the cavity.

The wall is traced as it is: a line of sight enters the outside, is refracted into the glass, leaves it at the near
side of the cavity and, where it meets air there, is refracted again and goes on to the far side (Snell's law; Hecht,
Optics, 4.4). All lengths in the axes of the vessel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.interpolate import PchipInterpolator

from zsdt.scene import VesselShape

STEP = 5e-4  # m between the samples of a profile
BEYOND = 0.05  # m that a profile is known above the rim and below the floor
ROOTS = 40  # steps of a search along a ray at most
CLOSE = 1e-8  # m from a wall is on it
MISSED, NEAR, FAR, OVER = (
    0,
    1,
    2,
    3,
)  # what a line of sight meets: nothing, near wall only, far wall, far wall over the rim


@dataclass(frozen=True)
class GlassWalls:
    """Outside and cavity of a glass, as tables: half-width [m] along x at heights `low + k STEP`.

    ratio: half-width along y over that along x, of the outside and of the cavity; exponent of the superellipse; rim
    [m]; index of refraction of the glass.
    """

    low: float
    outer: Float[np.ndarray, " samples"]
    inner: Float[np.ndarray, " samples"]
    ratio: tuple[float, float]
    exponent: float
    rim: float
    index: float

    @classmethod
    def of(cls, shape: VesselShape, wall: float, floor: float, index: float) -> GlassWalls:
        """Walls of a cavity with a wall of thickness `wall` [m], square to it, on a floor of glass [m]."""
        low = -max(BEYOND, floor)
        heights = np.arange(low, shape.rim + BEYOND, STEP)
        inner = np.interp(heights, shape.heights, shape.radii)
        if not shape.is_round:
            half = shape.radii[0]
            ratio = ((half * shape.aspect + wall) / (half + wall), shape.aspect)
            return cls(low, inner + wall, inner, ratio, shape.exponent, shape.rim, index)
        outer = np.interp(heights, *moved_profile(np.asarray(shape.heights), np.asarray(shape.radii), wall))
        return cls(low, outer, inner, (1.0, 1.0), 2.0, shape.rim, index)

    @classmethod
    def inside_of(
        cls, heights: Float[np.ndarray, " points"], radii: Float[np.ndarray, " points"], wall: float, index: float
    ) -> GlassWalls:
        """Walls of a round glass from its outside [m], smooth through its points (heights in the axes of the vessel,
        the rim last): where light passes two kinks, it is bent as by a prism that no real glass has."""
        z = np.concatenate([[heights[0] - BEYOND], heights, [heights[-1] + BEYOND]])
        slope = np.diff(radii)[[0, -1]] / np.diff(heights)[[0, -1]]
        ends = np.maximum(radii[[0, -1]] + slope * BEYOND * np.array([-1.0, 1.0]), 1e-3)
        smooth = PchipInterpolator(z, np.concatenate([ends[:1], radii, ends[1:]]))
        levels = np.arange(z[0], z[-1], STEP)
        outer = smooth(levels)
        inner = np.interp(levels, *moved_profile(levels, outer, -wall))
        return cls(float(z[0]), outer, inner, (1.0, 1.0), 2.0, float(heights[-1]), index)


def moved_profile(
    heights: Float[np.ndarray, " points"], radii: Float[np.ndarray, " points"], distance: float
) -> tuple[Float[np.ndarray, " kept"], Float[np.ndarray, " kept"]]:
    """A profile [m] moved along its normal by `distance` [m], outwards where positive; heights rise, none twice."""
    slope = np.gradient(radii, heights) if len(heights) > 2 else np.full(2, np.diff(radii)[0] / np.diff(heights)[0])
    length = np.sqrt(1.0 + slope**2)
    z, r = heights - distance * slope / length, radii + distance / length
    keep = np.concatenate([[True], z[1:] > np.maximum.accumulate(z)[:-1] + 1e-6])
    return z[keep], r[keep]


@njit(cache=True, error_model="numpy")
@no_type_check
def _excess(table, low, ratio, exponent, x, y, z):
    """How far (x, y, z) is outside of a wall [m], measured along the radius; negative inside."""
    f = (z - low) / STEP
    k = min(max(int(f), 0), len(table) - 2)
    f = min(max(f - k, 0.0), 1.0)
    radius = table[k] + f * (table[k + 1] - table[k])
    if exponent == 2.0 and ratio == 1.0:
        return math.sqrt(x * x + y * y) - radius
    across = (abs(x) / radius) ** exponent + (abs(y) / (ratio * radius)) ** exponent
    return radius * (across ** (1.0 / exponent) - 1.0)


@njit(cache=True, error_model="numpy")
@no_type_check
def _normal(table, low, ratio, exponent, x, y, z):
    """Unit normal of a wall, outwards."""
    e = 1e-6
    nx = _excess(table, low, ratio, exponent, x + e, y, z) - _excess(table, low, ratio, exponent, x - e, y, z)
    ny = _excess(table, low, ratio, exponent, x, y + e, z) - _excess(table, low, ratio, exponent, x, y - e, z)
    w = STEP  # a table is straight between its samples
    nz = _excess(table, low, ratio, exponent, x, y, z + w) - _excess(table, low, ratio, exponent, x, y, z - w)
    nz *= e / w
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@njit(cache=True, error_model="numpy")
@no_type_check
def _meet(table, low, ratio, exponent, px, py, pz, dx, dy, dz, outside, inside):
    """Length along the ray at which it crosses a wall, between a length outside and one inside of it."""
    f = _excess(table, low, ratio, exponent, px + outside * dx, py + outside * dy, pz + outside * dz)
    g = _excess(table, low, ratio, exponent, px + inside * dx, py + inside * dy, pz + inside * dz)
    middle, last = inside, 0
    for _ in range(ROOTS):  # regula falsi after Illinois
        middle = inside - g * (inside - outside) / (g - f) if g != f else 0.5 * (inside + outside)
        e = _excess(table, low, ratio, exponent, px + middle * dx, py + middle * dy, pz + middle * dz)
        if abs(e) < CLOSE:
            break
        if e > 0.0:
            outside, f = middle, e
            g = 0.5 * g if last > 0 else g
            last = 1
        else:
            inside, g = middle, e
            f = 0.5 * f if last < 0 else f
            last = -1
    return middle


@njit(cache=True, error_model="numpy")
@no_type_check
def _refract(dx, dy, dz, nx, ny, nz, ratio):
    """Direction after a surface with the normal (against the ray), `ratio` of the indices before and behind; True
    where it passes, else totally reflected."""
    cos = -(dx * nx + dy * ny + dz * nz)
    k = 1.0 - ratio * ratio * (1.0 - cos * cos)
    if k < 0.0:
        return dx, dy, dz, False
    c = ratio * cos - math.sqrt(k)
    return ratio * dx + c * nx, ratio * dy + c * ny, ratio * dz + c * nz, True


@njit(cache=True, error_model="numpy")
@no_type_check
def _deepest(table, low, ratio, exponent, px, py, pz, dx, dy, dz, reach):
    """Length along the ray, of 0 to `reach`, at which it is deepest inside of a wall (golden section)."""
    g = 0.6180339887498949
    a, b = 0.0, reach
    c, d = b - g * (b - a), a + g * (b - a)
    fc = _excess(table, low, ratio, exponent, px + c * dx, py + c * dy, pz + c * dz)
    fd = _excess(table, low, ratio, exponent, px + d * dx, py + d * dy, pz + d * dz)
    for _ in range(24):
        if fc < fd:
            b, d, fd = d, c, fc
            c = b - g * (b - a)
            fc = _excess(table, low, ratio, exponent, px + c * dx, py + c * dy, pz + c * dz)
        else:
            a, c, fc = c, d, fd
            d = a + g * (b - a)
            fd = _excess(table, low, ratio, exponent, px + d * dx, py + d * dy, pz + d * dz)
        if min(fc, fd) < -1e-4 and b - a < 0.02:  # well inside: good enough for a bracket
            break
    return c if fc < fd else d


@njit(cache=True, error_model="numpy")
@no_type_check
def sight(low, outer, inner, ratio_out, ratio_in, exponent, rim, index, px, py, pz, dx, dy, dz):
    """One line of sight from (px, py, pz) in the unit direction (dx, dy, dz), both in the axes of the vessel.

    Returns what it meets, the near point and the far point of the cavity's wall, and the direction between them.
    """
    horizontal = math.sqrt(dx * dx + dy * dy)
    size = 2.5 * max(outer.max(), outer.max() * ratio_out)
    closest = -(px * dx + py * dy) / max(horizontal, 1e-9) ** 2
    start = closest - size
    ox, oy, oz = px + start * dx, py + start * dy, pz + start * dz
    deep = _deepest(outer, low, ratio_out, exponent, ox, oy, oz, dx, dy, dz, 2.0 * size)
    if _excess(outer, low, ratio_out, exponent, ox + deep * dx, oy + deep * dy, oz + deep * dz) >= 0.0:
        return MISSED, (np.nan, np.nan, np.nan), (np.nan, np.nan, np.nan), (dx, dy, dz)
    s = _meet(outer, low, ratio_out, exponent, ox, oy, oz, dx, dy, dz, 0.0, deep)
    x, y, z = ox + s * dx, oy + s * dy, oz + s * dz
    met = FAR
    if z > rim:  # over the rim: nothing refracts
        deep = _deepest(inner, low, ratio_in, exponent, ox, oy, oz, dx, dy, dz, 2.0 * size)
        if _excess(inner, low, ratio_in, exponent, ox + deep * dx, oy + deep * dy, oz + deep * dz) >= 0.0:
            return MISSED, (np.nan, np.nan, np.nan), (np.nan, np.nan, np.nan), (dx, dy, dz)
        s = _meet(inner, low, ratio_in, exponent, ox, oy, oz, dx, dy, dz, 0.0, deep)
        x, y, z = ox + s * dx, oy + s * dy, oz + s * dz
        met = OVER
    else:
        nx, ny, nz = _normal(outer, low, ratio_out, exponent, x, y, z)
        dx, dy, dz, _ = _refract(dx, dy, dz, nx, ny, nz, 1.0 / index)
        deep = _deepest(inner, low, ratio_in, exponent, x, y, z, dx, dy, dz, size)
        if _excess(inner, low, ratio_in, exponent, x + deep * dx, y + deep * dy, z + deep * dz) >= 0.0:
            return MISSED, (np.nan, np.nan, np.nan), (np.nan, np.nan, np.nan), (dx, dy, dz)
        s = _meet(inner, low, ratio_in, exponent, x, y, z, dx, dy, dz, 0.0, deep)
        x, y, z = x + s * dx, y + s * dy, z + s * dz
        nx, ny, nz = _normal(inner, low, ratio_in, exponent, x, y, z)
        dx, dy, dz, passes = _refract(dx, dy, dz, nx, ny, nz, index)
        if not passes:
            return NEAR, (x, y, z), (np.nan, np.nan, np.nan), (dx, dy, dz)
    deep = _deepest(inner, low, ratio_in, exponent, x, y, z, dx, dy, dz, size)
    s = _meet(inner, low, ratio_in, exponent, x, y, z, dx, dy, dz, size, deep)
    return met, (x, y, z), (x + s * dx, y + s * dy, z + s * dz), (dx, dy, dz)


@njit(cache=True, error_model="numpy")
@no_type_check
def _contacts(low, outer, inner, ratio_out, ratio_in, exponent, rim, index, eye, rays, points, seen):
    for i in range(len(rays)):
        met, near, far, way = sight(
            low, outer, inner, ratio_out, ratio_in, exponent, rim, index,
            eye[0], eye[1], eye[2], rays[i, 0], rays[i, 1], rays[i, 2],
        )  # fmt: skip
        seen[i] = met
        # The liquid's edge is where the line of sight is lowest inside the cavity: far for a camera that looks down.
        chosen = far if met >= FAR and way[2] < 0.0 else near
        points[i, 0], points[i, 1], points[i, 2] = chosen[0], chosen[1], chosen[2]


def contacts(
    walls: GlassWalls, eye: Float[np.ndarray, "3"], rays: Float[np.ndarray, "rays 3"]
) -> tuple[Float[np.ndarray, "rays 3"], np.ndarray]:
    """Points of the cavity's wall [m] at which lines of sight just miss a liquid, and what each line meets.

    eye [3] m: the camera in the axes of the vessel; rays [rays, 3]: unit directions. A surface that is level into the
    depth ends in the picture where a line of sight touches it at the lowest point of its way through the cavity: on
    the far wall for a camera that looks down, on the near wall for one that looks up. NaN and `MISSED` where a line
    of sight does not pass through the cavity; `NEAR` where it is totally reflected at the near wall.
    """
    points, seen = np.empty((len(rays), 3)), np.zeros(len(rays), np.int64)
    _contacts(
        walls.low, walls.outer, walls.inner, *walls.ratio, walls.exponent, walls.rim, walls.index,
        np.ascontiguousarray(eye, np.float64), np.ascontiguousarray(rays, np.float64), points, seen,
    )  # fmt: skip
    return points, seen
