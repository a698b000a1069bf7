"""A glass with liquid as rays meet it: where a ray hits wall, floor, rim and free surface next, and the normal there.

Functions that take a whole `Solid` are inlined: handing over its arrays at every call cost a fifth of the time.
Coordinates are the vessel's. Round walls are frustums with normals interpolated between the points of the profile,
prisms are polygons with the normals of their superellipse, the free surface is a grid of heights and slopes.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Float
from numba import njit

from zsdt.lab.glass_surface import wall_radius
from zsdt.lab.glass_view import Glass, outer_profile

NOTHING, OUTER, INNER, FLOOR, BASE, RIM, MOUTH, SURFACE = range(8)  # what a ray meets
OUT, GLASS, AIR, LIQUID = range(4)  # what it is in: the room, the glass, the empty part of the cavity, the liquid
FAR = 5.0  # m: nothing is met beyond
NEAR = 2e-6  # m: a surface nearer than that is the one the ray comes from
GRID = 56  # points of the surface along each axis
EDGES = 96  # of the polygon that stands for a prism
STEPS, HALVINGS = 10, 10  # of the search for the surface along a ray
FILLET = 0.0015  # m: radius of the edge of the foot


class Solid(NamedTuple):
    """A glass as arrays, for compiled code.

    outer, inner [points, 5]: height, radius, normal (along z, outward) and slope of the next piece, of both profiles.
    outer_edges, inner_edges [edges, 3]: outward normal and distance from the axis of the sides of a prism, empty for
    round glasses. section: exponent and aspects (outside, inside) of a prism. field [3, grid, grid]: height of the free
    surface and its slopes along x and y; low, scale: place of its first point and points per metre; lowest, highest: of
    the heights (-1 in an empty glass). liquid, glass: indices of refraction.
    """

    outer: np.ndarray
    inner: np.ndarray
    outer_edges: np.ndarray
    inner_edges: np.ndarray
    section: np.ndarray
    field: np.ndarray
    low: float
    scale: float
    lowest: float
    highest: float
    liquid: float
    glass: float


def _with_normals(heights: np.ndarray, radii: np.ndarray) -> Float[np.ndarray, "points 5"]:
    """Profile with normals and slopes: normals of a point are a mean of those of the pieces that meet there.

    Pieces count by the square of their length: where a straight wall meets a small round edge, it stays straight.
    """
    rise, widen = np.diff(heights), np.diff(radii)
    length = np.hypot(rise, widen)
    pieces = np.stack([-widen / length, rise / length], axis=1)
    weighted = pieces * (length**2)[:, None]
    points = np.concatenate([pieces[:1], weighted[1:] + weighted[:-1], pieces[-1:]])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.column_stack([heights, radii, points, np.append(widen / rise, 0.0)])


def _rounded(glass: Glass) -> tuple[Float[np.ndarray, "outside 5"], Float[np.ndarray, "inside 5"]]:
    """Outer and inner profile of a round glass with a rim of half a circle and a rounded edge of the foot."""
    (z_out, r_out), vessel = outer_profile(glass.vessel, glass.wall, glass.floor), glass.vessel
    z_in, r_in = np.asarray(vessel.heights, float), np.asarray(vessel.radii, float)
    rim, high, middle = vessel.rim, 0.5 * glass.wall, 0.5 * (r_out[-1] + r_in[-1])
    turn = np.linspace(0.0, 0.5 * np.pi, 5)
    up = rim - high * (1.0 - np.sin(turn))
    below_out, below_in = z_out < rim - high - 1e-6, z_in < rim - high - 1e-6
    ends = [float(np.interp(rim - high, z, r)) for z, r in ((z_out, r_out), (z_in, r_in))]
    outer = [np.append(z_out[below_out], up), np.append(r_out[below_out], middle + (ends[0] - middle) * np.cos(turn))]
    inner = [np.append(z_in[below_in], up), np.append(r_in[below_in], middle + (ends[1] - middle) * np.cos(turn))]
    edge = min(FILLET, 0.4 * glass.floor)
    kept = outer[0] > z_out[0] + edge + 1e-6
    outer[0] = np.concatenate([z_out[0] + edge * (1.0 - np.cos(turn)), outer[0][kept]])
    outer[1] = np.concatenate([r_out[0] - edge * (1.0 - np.sin(turn)), outer[1][kept]])
    return _with_normals(*outer), _with_normals(*inner)


def _edges(half_x: float, half_y: float, exponent: float) -> Float[np.ndarray, "edges 3"]:
    """Sides of the polygon around a superellipse: tangents at even angles."""
    angle = 2.0 * np.pi * (np.arange(EDGES) + 0.5) / EDGES
    cos, sin = np.cos(angle), np.sin(angle)
    reach = (np.abs(cos) ** exponent + np.abs(sin) ** exponent) ** (-1.0 / exponent)
    x, y = half_x * reach * cos, half_y * reach * sin
    nx = np.sign(x) * np.abs(x / half_x) ** (exponent - 1.0) / half_x
    ny = np.sign(y) * np.abs(y / half_y) ** (exponent - 1.0) / half_y
    length = np.hypot(nx, ny)
    nx, ny = nx / length, ny / length
    return np.ascontiguousarray(np.stack([nx, ny, nx * x + ny * y], axis=1))


def _field(glass: Glass, low: float, step: float) -> Float[np.ndarray, "3 grid grid"]:
    """Height of the free surface and its slopes along x and y on a square grid; [:, y, x]."""
    if glass.height is None:
        return np.stack([np.full((GRID, GRID), -1.0), np.zeros((GRID, GRID)), np.zeros((GRID, GRID))])
    rings, angles = glass.height.shape
    at = low + step * np.arange(GRID)
    x, y = np.meshgrid(at, at)
    turn = np.arctan2(y, x) % (2.0 * np.pi) * angles / (2.0 * np.pi)
    angle = 2.0 * np.pi * np.arange(angles + 1) / angles
    contact = np.append(glass.height[-1], glass.height[-1, 0])
    reach = np.interp(turn, np.arange(angles + 1), wall_radius(glass.vessel, angle, contact))
    ring = np.minimum(np.hypot(x, y) / reach, 1.15) * (rings - 1)
    # Beyond the contact line, which bends between grid points, the surface goes on along its slope.
    beyond = 2.0 * glass.height[-1] - glass.height[-2]
    further = 3.0 * glass.height[-1] - 2.0 * glass.height[-2]
    polar = np.concatenate([glass.height, beyond[None], further[None]])
    polar = np.concatenate([polar, polar[:, :1]], axis=1)
    height = cv2.remap(polar, turn.astype(np.float32), ring.astype(np.float32), cv2.INTER_LINEAR)
    height = cv2.GaussianBlur(height, (0, 0), 0.7, borderType=cv2.BORDER_REPLICATE)
    slopes = np.gradient(height, step)
    return np.stack([height, slopes[1], slopes[0]])


def solid_of(glass: Glass) -> Solid:
    """The glass as arrays."""
    vessel = glass.vessel
    half = max(vessel.radii) * max(vessel.aspect, 1.0) * 1.08
    step = 2.0 * half / (GRID - 1)
    field = _field(glass, -half, step)
    none = np.zeros((0, 3))
    if vessel.is_round:
        (outer, inner), edges, section = _rounded(glass), (none, none), np.array([2.0, 1.0, 1.0])
    else:
        outer = _with_normals(*outer_profile(vessel, glass.wall, glass.floor))
        inner = _with_normals(np.asarray(vessel.heights, float), np.asarray(vessel.radii, float))
        a, b = vessel.radii[0], vessel.radii[0] * vessel.aspect
        edges = (
            _edges(a + glass.wall, b + glass.wall, vessel.exponent),
            _edges(a, b, vessel.exponent),
        )
        section = np.array([vessel.exponent, (b + glass.wall) / (a + glass.wall), vessel.aspect])
    lowest, highest = (-1.0, -1.0) if glass.height is None else (float(field[0].min()), float(field[0].max()))
    return Solid(
        outer, inner, *edges, section, field, -half, 1.0 / step, lowest, highest, glass.liquid_index, glass.glass_index
    )


@njit(cache=True, error_model="numpy")
@no_type_check
def _meet_round(ray, profile, limit):
    """Distance along the ray to a body of revolution, and the piece of its profile; -1 where it is missed within the
    limit."""
    px, py, pz, dx, dy, dz = ray[0], ray[1], ray[2], ray[3], ray[4], ray[5]
    flat, along, square = dx * dx + dy * dy, px * dx + py * dy, px * px + py * py
    best, piece = limit, -1
    inverse = 1.0 / (dz if abs(dz) > 1e-12 else 1e-12)
    for k in range(len(profile) - 1):
        z1, z2 = profile[k, 0], profile[k + 1, 0]
        # The part of the ray between the heights of this piece.
        first, last = (z1 - pz) * inverse, (z2 - pz) * inverse
        if first > last:
            first, last = last, first
        if last < NEAR or first > best:
            continue
        m = profile[k, 4]
        w = profile[k, 1] + m * (pz - z1)
        a, b, c = flat - m * m * dz * dz, along - m * w * dz, square - w * w
        root = b * b - a * c
        if root < 0.0 or abs(a) < 1e-12:
            continue
        root = math.sqrt(root)
        for sign in (-1.0, 1.0):
            t = (-b + sign * root) / a
            if NEAR < t < best and first <= t <= last and w + m * t * dz > 0.0:
                best, piece = t, k
    return (best, piece) if piece >= 0 else (-1.0, -1)


@njit(cache=True, error_model="numpy")
@no_type_check
def _meet_prism(ray, edges, bottom, top):
    """Distance along the ray to the sides of a prism between two heights; -1 where it is missed."""
    enter, leave = -1e9, 1e9
    for k in range(len(edges)):
        slope = edges[k, 0] * ray[3] + edges[k, 1] * ray[4]
        gap = edges[k, 2] - edges[k, 0] * ray[0] - edges[k, 1] * ray[1]
        if slope > 1e-12:
            leave = min(leave, gap / slope)
        elif slope < -1e-12:
            enter = max(enter, gap / slope)
        elif gap < 0.0:
            return -1.0
    if enter > leave:
        return -1.0
    for t in (enter, leave):
        if t > NEAR and bottom <= ray[2] + t * ray[5] <= top:
            return t
    return -1.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _within(x, y, radius, exponent, aspect):
    """Whether a point lies within a cross-section of this half-width along x."""
    if exponent == 2.0 and aspect == 1.0:
        return x * x + y * y < radius * radius
    return (abs(x) / radius) ** exponent + (abs(y) / (aspect * radius)) ** exponent < 1.0


@njit(inline="always", error_model="numpy")
@no_type_check
def look_up(solid, which, x, y):
    """Height (0) or slope along x (1) or y (2) of the free surface."""
    grid = solid.field
    last = grid.shape[1] - 1.0001
    u = min(max((x - solid.low) * solid.scale, 0.0), last)
    v = min(max((y - solid.low) * solid.scale, 0.0), last)
    i, j = int(u), int(v)
    u, v = u - i, v - j
    top = grid[which, j, i] * (1.0 - u) + grid[which, j, i + 1] * u
    low = grid[which, j + 1, i] * (1.0 - u) + grid[which, j + 1, i + 1] * u
    return top * (1.0 - v) + low * v


@njit(inline="always", error_model="numpy")
@no_type_check
def _meet_surface(ray, end, solid, below):
    """Distance along the ray to the free surface before `end`, seen from `below` or above; -1 where there is none."""
    z1, z2 = ray[2], ray[2] + end * ray[5]
    if (below and max(z1, z2) < solid.lowest) or (not below and min(z1, z2) > solid.highest):
        return -1.0
    before = 0.0
    for k in range(1, STEPS + 1):
        t = end * k / STEPS
        under = ray[2] + t * ray[5] < look_up(solid, 0, ray[0] + t * ray[3], ray[1] + t * ray[4])
        if under != below:
            for _ in range(HALVINGS):
                middle = 0.5 * (before + t)
                under = ray[2] + middle * ray[5] < look_up(solid, 0, ray[0] + middle * ray[3], ray[1] + middle * ray[4])
                if under == below:
                    before = middle
                else:
                    t = middle
            return t if t > NEAR else -1.0
        before = t
    return -1.0


@njit(inline="always", error_model="numpy")
@no_type_check
def _side(ray, solid, outside, limit):
    """Distance to the outer or inner wall and the piece of its profile."""
    profile = solid.outer if outside else solid.inner
    edges = solid.outer_edges if outside else solid.inner_edges
    if len(edges):
        return _meet_prism(ray, edges, profile[0, 0], profile[-1, 0]), 0
    return _meet_round(ray, profile, limit)


@njit(inline="always", error_model="numpy")
@no_type_check
def next_surface(ray, medium, solid):
    """What the ray meets next in a medium: distance, kind, piece of a profile."""
    exponent, outer_aspect, inner_aspect = solid.section
    rim, base = solid.outer[-1, 0], solid.outer[0, 0]
    best, kind, piece = FAR, NOTHING, -1
    if medium != OUT:
        t, k = _side(ray, solid, False, FAR)
        if t > 0.0:
            best, kind, piece = t, INNER, k
    if medium in (OUT, GLASS):
        t, k = _side(ray, solid, True, best)
        if 0.0 < t < best:
            best, kind, piece = t, OUTER, k
    dz = ray[5]
    if dz != 0.0:
        t = (rim - ray[2]) / dz
        if NEAR < t < best and (dz < 0.0) == (medium == OUT):
            x, y = ray[0] + t * ray[3], ray[1] + t * ray[4]
            if _within(x, y, solid.inner[-1, 1], exponent, inner_aspect):
                if medium != GLASS:
                    best, kind = t, MOUTH
            elif medium != AIR and _within(x, y, solid.outer[-1, 1], exponent, outer_aspect):
                best, kind = t, RIM
        t = -ray[2] / dz
        possible = NEAR < t < best and medium != OUT and (dz > 0.0) == (medium == GLASS)
        if possible and _within(ray[0] + t * ray[3], ray[1] + t * ray[4], solid.inner[0, 1], exponent, inner_aspect):
            best, kind = t, FLOOR
        t = (base - ray[2]) / dz
        if NEAR < t < best and medium == GLASS and dz < 0.0:
            best, kind = t, BASE
    if medium in (AIR, LIQUID):
        t = _meet_surface(ray, min(best, 1.0), solid, medium == LIQUID)
        if t > 0.0:
            best, kind = t, SURFACE
    return best, kind, piece


@njit(inline="always", error_model="numpy")
@no_type_check
def normal_at(ray, kind, piece, solid, normal):
    """Unit normal at the place of the ray, out of the glass or up, into `normal`."""
    if kind == SURFACE:
        nx, ny, nz = -look_up(solid, 1, ray[0], ray[1]), -look_up(solid, 2, ray[0], ray[1]), 1.0
    elif kind in (OUTER, INNER):
        profile = solid.outer if kind == OUTER else solid.inner
        edges = solid.outer_edges if kind == OUTER else solid.inner_edges
        if len(edges):
            n = solid.section[0]
            b = solid.section[1] if kind == OUTER else solid.section[2]
            nx = math.copysign(abs(ray[0] / profile[0, 1]) ** (n - 1.0), ray[0])
            ny = math.copysign(abs(ray[1] / (b * profile[0, 1])) ** (n - 1.0) / b, ray[1])
            nz = 0.0
        else:
            share = (ray[2] - profile[piece, 0]) / (profile[piece + 1, 0] - profile[piece, 0])
            nz = (1.0 - share) * profile[piece, 2] + share * profile[piece + 1, 2]
            out = (1.0 - share) * profile[piece, 3] + share * profile[piece + 1, 3]
            r = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1]) + 1e-12
            nx, ny = out * ray[0] / r, out * ray[1] / r
    else:
        nx, ny, nz = 0.0, 0.0, 1.0
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    normal[0], normal[1], normal[2] = nx / length, ny / length, nz / length
