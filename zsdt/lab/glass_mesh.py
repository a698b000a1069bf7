"""Triangle meshes of a glass with a liquid in it, as nested dielectrics: glass-air, glass-liquid and liquid-air.

Each mesh is one interface between two media, so that a ray crosses exactly one surface wherever the medium changes.
Glass-air and glass-liquid together enclose the glass, glass-liquid and liquid-air enclose the liquid, glass-air and
liquid-air enclose both: along the contact line the three share the same points. Normals of vertices are those of the
smooth body, not of its triangles.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.interpolate
from jaxtyping import Float, Int

from zsdt.lab.glass_view import Glass
from zsdt.scene import VesselShape

Lattice = tuple[np.ndarray, np.ndarray]  # points and normals [rows, angles, 3]
ANGLES = 128  # columns of the meshes
RINGS = 24  # of the free surface
STRAIGHT_STEP, CURVED_STEP = 0.005, 0.0006  # m between rows along a wall
STRAIGHT = 0.005  # change of its slope over a piece of a profile that still counts as straight
FOOT_RADIUS = 0.0015  # m, of the rounded edge that the glass stands on
RIM_HEIGHT = 0.001  # m, of the rounded rim, but at most half of the wall
ARC_ROWS = 7  # along a rounded edge
FILM = 2e-4  # m: the surface stays that far above the floor and below the rounded rim


@dataclass(frozen=True)
class Mesh:
    """A surface: vertices [m], unit normals at them, and triangles that run counter-clockwise seen from the side to
    which the normals point. No triangle has an area of zero."""

    vertices: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]

    def volume(self) -> float:
        """Volume [m3] that a closed surface encloses; the part of it that an open one contributes (divergence
        theorem: a sixth of the sum of det [a, b, c] over its triangles)."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float(np.einsum("fk,fk->", a, np.cross(b, c))) / 6.0

    def flipped(self) -> Mesh:
        """The same surface seen from its other side."""
        return Mesh(self.vertices, -self.normals, self.faces[:, ::-1])


@dataclass(frozen=True)
class GlassMeshes:
    """The interfaces of a glass, in the axes of the vessel.

    glass_air: normals from the glass to the air; glass_liquid: from the liquid to the glass; liquid_air: from the
    liquid to the air. The last two are None for an empty glass.
    """

    glass_air: Mesh
    glass_liquid: Mesh | None
    liquid_air: Mesh | None


def joined(meshes: list[Mesh]) -> Mesh:
    """Several surfaces as one list of triangles; vertices are not merged."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]),
    )


class CrossSection:
    """Horizontal sections of a vessel, by polar angle about its axis (from x to y).

    unit [angles, 2]: the wall of half-width 1 along x; outward [angles, 2]: its normal.
    """

    def __init__(self, vessel: VesselShape, angles: int = ANGLES):
        turn = 2.0 * np.pi * np.arange(angles) / angles
        cos, sin = np.cos(turn), np.sin(turn)
        self.vessel = vessel
        if vessel.is_round:
            self.unit = self.outward = np.stack([cos, sin], axis=1)
            return
        n, aspect = vessel.exponent, vessel.aspect
        reach = (np.abs(cos) ** n + np.abs(sin / aspect) ** n) ** (-1.0 / n)
        self.unit = reach[:, None] * np.stack([cos, sin], axis=1)
        steep = np.stack(
            [np.sign(cos) * np.abs(cos) ** (n - 1), np.sign(sin) * np.abs(sin / aspect) ** (n - 1) / aspect], axis=1
        )
        self.outward = steep / np.linalg.norm(steep, axis=1, keepdims=True)

    def rings(self, radius: np.ndarray, height: np.ndarray) -> Float[np.ndarray, "rows angles 3"]:
        """Rings of half-width `radius` along x at `height` [m], both [rows] or [rows, angles].

        Round vessels: circles. Prisms: curves parallel to the wall of the cavity, not scaled copies of it.
        """
        size = (len(radius), len(self.unit))
        wide = np.broadcast_to(radius.reshape(len(radius), -1), size)[..., None]
        inner = self.vessel.radii[0]
        flat = wide * self.unit if self.vessel.is_round else inner * self.unit + (wide - inner) * self.outward
        return np.concatenate([flat, np.broadcast_to(height.reshape(len(height), -1), size)[..., None]], axis=2)

    def normals(self, across: np.ndarray, up: np.ndarray) -> Float[np.ndarray, "rows angles 3"]:
        """Normals with parts `across` along the normal of the section and `up` along z, [rows] or [rows, angles]."""
        size = (len(across), len(self.unit))
        flat = np.broadcast_to(across.reshape(len(across), -1), size)[..., None] * self.outward
        return np.concatenate([flat, np.broadcast_to(up.reshape(len(up), -1), size)[..., None]], axis=2)


class Profile:
    """A wall as half-width over height: a smooth curve through its points, straight where they are."""

    def __init__(self, heights: np.ndarray, radii: np.ndarray):
        self.heights, self.radii = np.asarray(heights, float), np.asarray(radii, float)
        rise, pieces = np.diff(self.heights), np.diff(self.radii) / np.diff(self.heights)
        # Of the pieces that meet in a point the longer one decides: a straight wall stays straight up to a bend.
        square = rise**2 * (1.0 + pieces**2)
        inner = (square[1:] * pieces[1:] + square[:-1] * pieces[:-1]) / (square[1:] + square[:-1])
        slopes = np.concatenate([pieces[:1], inner, pieces[-1:]])
        # Chords with a normal that turns smoothly over them would act as a row of weak prisms.
        self._radius = scipy.interpolate.CubicHermiteSpline(self.heights, self.radii, slopes)
        self._slope = self._radius.derivative()
        is_straight = np.abs(np.diff(slopes)) + np.abs(pieces - slopes[:-1]) < STRAIGHT
        self._steps = np.where(is_straight, STRAIGHT_STEP, CURVED_STEP)

    def radius(self, height: np.ndarray | float) -> np.ndarray:
        """Half-width along x [m] at heights [m]."""
        return np.asarray(self._radius(np.clip(height, self.heights[0], self.heights[-1])))

    def normal(self, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Away from the axis: parts of the unit normal along the radius and along z."""
        slope = self._slope(np.clip(height, self.heights[0], self.heights[-1]))
        length = np.sqrt(1.0 + slope**2)
        return 1.0 / length, -slope / length

    def rows(self, low: float, high: float) -> Float[np.ndarray, " rows"]:
        """Heights from `low` to `high` [m] with all points of the profile between them, close where it is curved."""
        stops = np.concatenate(
            [[low], self.heights[(self.heights > low + 1e-6) & (self.heights < high - 1e-6)], [high]]
        )
        parts = []
        for a, b in itertools.pairwise(stops):
            piece = np.searchsorted(self.heights, 0.5 * (a + b)) - 1
            step = self._steps[np.clip(piece, 0, len(self._steps) - 1)]
            parts.append(np.linspace(a, b, max(int(np.ceil((b - a) / step)), 1) + 1)[:-1])
        return np.concatenate([*parts, [high]])


class GlassMesher:
    """Makes the meshes of one glass for any free surface in it."""

    def __init__(self, vessel: VesselShape, wall: float, floor: float, angles: int = ANGLES):
        self._glass = vessel, wall, floor
        self.section = CrossSection(vessel, angles)
        self.inner = Profile(np.array(vessel.heights), np.array(vessel.radii))
        self.wall, self.floor = wall, floor
        self.rim_height = min(RIM_HEIGHT, 0.5 * wall)
        self.foot = min(FOOT_RADIUS, 0.6 * wall, 0.3 * floor)
        self.wall_top = vessel.rim - self.rim_height

    def made_for(self, vessel: VesselShape, wall: float, floor: float) -> bool:
        """Whether these are the meshes of such a glass."""
        return self._glass == (vessel, wall, floor)

    def meshes(self, height: Float[np.ndarray, "rings angles"] | None) -> GlassMeshes:
        """The interfaces for a free surface as `zsdt.lab.glass_view.Glass` has it; None: empty."""
        base = self.inner.radius(0.0)
        floor = self._disc(float(base), 0.0)
        if height is None:
            dry = self.inner.rows(0.0, self.wall_top)[:, None]
            inside = [_turned(floor), self._inner_wall(dry)]
            return GlassMeshes(joined([*self._outside, *map(_mesh, inside)]), None, None)
        surface = self._surface(height)
        contact = surface[0][0, :, 2]
        # Rows that suit the mean contact line; where it runs higher or lower they are spread or pressed together.
        mean = float(contact.mean())
        below = (self.inner.rows(0.0, mean) / mean)[:, None] * contact
        part = ((self.inner.rows(mean, self.wall_top) - mean) / (self.wall_top - mean))[:, None]
        above = contact * (1.0 - part) + self.wall_top * part
        return GlassMeshes(
            glass_air=joined([*self._outside, _mesh(self._inner_wall(above))]),
            glass_liquid=joined([_mesh(floor), _mesh(_turned(self._inner_wall(below)))]),
            liquid_air=_mesh(surface),
        )

    @cached_property
    def _outside(self) -> list[Mesh]:
        """Bottom, rounded foot, outer wall and rounded rim: the part that no liquid changes."""
        low, f = -self.floor + self.foot, self.foot
        walls = self._outer_walls(low)
        edge, out = float(walls[0][0][0, 0, 0]), float(walls[-1][0][-1, 0, 0])
        quarter = np.linspace(0.0, 0.5 * np.pi, ARC_ROWS)
        sin, cos = np.sin(quarter), np.cos(quarter)
        foot = self.section.rings(edge - f + f * sin, low - f * cos), self.section.normals(sin, -cos)
        into = float(self.inner.radius(self.wall_top))
        half = np.linspace(0.0, np.pi, 2 * ARC_ROWS - 1)
        sin, cos = np.sin(half), np.cos(half)
        a, b = 0.5 * (out - into), self.rim_height
        length = np.hypot(b * cos, a * sin)
        heights = self.wall_top + b * sin
        heights[-1] = self.wall_top
        rim = (
            self.section.rings(0.5 * (out + into) + a * cos, heights),
            self.section.normals(b * cos / length, a * sin / length),
        )
        return [_mesh(part) for part in (self._disc(edge - f, -self.floor), foot, *walls, rim)]

    def _outer_walls(self, low: float) -> list[Lattice]:
        """The outer wall from `low` up to the rim: parallel to the inner one, and straight down below its floor."""
        rows = self.inner.rows(0.0, self.section.vessel.rim)
        across, up = self.inner.normal(rows)
        height, radius = rows + self.wall * up, self.inner.radius(rows) + self.wall * across
        rises = np.concatenate([[True], height[1:] > np.maximum.accumulate(height)[:-1] + 1e-6])
        height, radius, across, up = height[rises], radius[rises], across[rises], up[rises]
        start, top = max(float(height[0]), low), self.wall_top
        between = height[(height > start + 1e-6) & (height < top - 1e-6)]
        rows = np.concatenate([[start], between, [top]])
        wall, outwards = (
            self.section.rings(np.interp(rows, height, radius), rows),
            self.section.normals(*_unit(np.interp(rows, height, across), np.interp(rows, height, up))),
        )
        if start < low + 1e-6:
            return [(wall, outwards)]
        skirt = np.array([low, start])
        return [
            (self.section.rings(np.full(2, radius[0]), skirt), self.section.normals(np.ones(2), np.zeros(2))),
            (wall, outwards),
        ]

    def _disc(self, radius: float, height: float) -> Lattice:
        """A flat floor seen from below."""
        ring = self.section.rings(np.array([radius]), np.array([height]))[0]
        share = np.linspace(0.0, 1.0, 6)[:, None, None]
        points = share * ring
        points[..., 2] = height
        return points, np.broadcast_to([0.0, 0.0, -1.0], points.shape)

    def _inner_wall(self, rows: np.ndarray) -> Lattice:
        """The wall of the cavity over rows of heights [rows, 1 or angles], seen from inside it."""
        across, up = self.inner.normal(rows)
        points = self.section.rings(self.inner.radius(rows), rows)
        return points[::-1], -self.section.normals(across, up)[::-1]

    def _surface(self, height: Float[np.ndarray, "rings angles"]) -> Lattice:
        """The free surface over a finer polar grid, from the wall to the axis, seen from above."""
        angles = len(self.section.unit)
        fine = _refined(height, RINGS, angles)
        fine = np.clip(fine, FILM, self.wall_top - FILM)
        contact = self.section.rings(self.inner.radius(fine[-1])[None], fine[-1:])[0]
        points = np.linspace(0.0, 1.0, RINGS)[:, None, None] * contact
        points[..., 2] = fine
        along = np.gradient(points, axis=0)
        around = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
        normals = np.cross(along, around)
        normals[0] = normals[1].mean(axis=0)
        return points[::-1], (normals / np.linalg.norm(normals, axis=2, keepdims=True))[::-1]


def glass_meshes(glass: Glass, angles: int = ANGLES) -> GlassMeshes:
    """The interfaces of a glass in the axes of its vessel (see `GlassMeshes`)."""
    return GlassMesher(glass.vessel, glass.wall, glass.floor, angles).meshes(glass.height)


def _unit(across: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.hypot(across, up)
    return across / length, up / length


def _refined(height: np.ndarray, rings: int, angles: int) -> Float[np.ndarray, "rings angles"]:
    """A polar height field by cubic splines on a finer polar grid; around the axis it is periodic."""
    turns = np.arange(height.shape[1] + 1) / height.shape[1]
    closed = np.concatenate([height, height[:, :1]], axis=1)
    around = scipy.interpolate.CubicSpline(turns, closed, axis=1, bc_type="periodic")(np.arange(angles) / angles)
    share = np.linspace(0.0, 1.0, len(height))
    return scipy.interpolate.PchipInterpolator(share, around, axis=0)(np.linspace(0.0, 1.0, rings))


def _turned(lattice: Lattice) -> Lattice:
    """The other side of a lattice surface."""
    return lattice[0][::-1], -lattice[1][::-1]


def _mesh(lattice: Lattice) -> Mesh:
    """Triangles of a lattice [rows, angles, 3] that is closed along its second axis; (angle) x (row) is outwards.

    A row that is one point becomes a fan.
    """
    points, normals = lattice
    rows, angles = points.shape[:2]
    index: Callable[[int, int], np.ndarray] = lambda row, turn: (  # noqa: E731
        (np.arange(rows - 1)[:, None] + row) * angles + (np.arange(angles)[None] + turn) % angles
    )
    a, b, c, d = index(0, 0), index(0, 1), index(1, 1), index(1, 0)
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    flat = np.ascontiguousarray(points).reshape(-1, 3)
    sides = flat[faces] - flat[np.roll(faces, 1, axis=1)]
    return Mesh(
        flat, np.ascontiguousarray(normals).reshape(-1, 3), faces[(np.abs(sides).max(axis=2) > 1e-12).all(axis=1)]
    )
