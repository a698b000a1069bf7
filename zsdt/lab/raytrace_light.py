"""Light through nested dielectrics: the tree of refractions and reflections of a ray, followed exactly.

Everything that shines in the scene is outside of the glass and every surface of the glass is smooth, so nothing has to
be drawn at random: at each surface Fresnel's equations share the light of an unpolarised ray, Snell's law and the law
of reflection turn it, and the law of Beer and Lambert weakens it on the way (Whitted 1980). The picture has no noise
of its own, and the same rays tell which pixels show liquid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from zsdt.lab.glass_mesh import Mesh, joined
from zsdt.lab.raytrace_caster import Hits

LIQUID_WITHIN = 6  # surfaces: what is met later counts as seen in the glass, not as liquid
LEAP = 1e-5  # m that a ray starts beyond the surface that it has left
STRONG = 0.15  # reflected share above which a reflection is followed in every sample of a pixel
FAINT = 0.003  # share of a pixel's light below which a ray is no longer followed
SIDE, SIGHT, BLIND = range(3)  # rays: a reflection; a line of sight; one that goes on along the inside of the glass
CONTAINER, LIQUID = 1, 2  # bits of what a line of sight has met

Light = Callable[[np.ndarray, np.ndarray], Float[np.ndarray, "rays 3"]]
"""Radiance [rays, 3] that comes to `origins` [rays, 3] m from where `directions` point, with no glass in between."""


Cast = Callable[[np.ndarray, np.ndarray], Hits]
"""Finds the first triangle that each ray from `origins` [rays, 3] m along unit `directions` [rays, 3] meets."""


class Medium(NamedTuple):
    """What a ray travels in: index of refraction and absorption [3] 1/m of each colour."""

    refraction: float
    absorption: Float[np.ndarray, "3"]


AIR = Medium(1.0, np.zeros(3))


class Interface(NamedTuple):
    """A surface between two media: its normals point from `inside` to `outside`; is_liquid: it bounds a liquid."""

    mesh: Mesh
    inside: Medium
    outside: Medium
    is_liquid: bool


class Surfaces(NamedTuple):
    """Triangles and the media on both sides of each, as arrays for compiled code.

    points, normals [vertices, 3]; faces [faces, 3]; sides [faces, 2]: medium inside and outside; is_liquid [faces];
    refraction [media]: their indices; absorption [media, 3] 1/m.
    """

    points: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    sides: np.ndarray
    is_liquid: np.ndarray
    refraction: np.ndarray
    absorption: np.ndarray


class Rays(NamedTuple):
    """Rays on their way: whose light they carry [rays], from where [rays, 3] m, whither [rays, 3], with what weight
    [rays, 3], and what they are [rays] (SIDE, SIGHT, BLIND)."""

    owner: np.ndarray
    place: np.ndarray
    way: np.ndarray
    weight: np.ndarray
    state: np.ndarray

    def first(self, count: int) -> Rays:
        """The first `count` rays."""
        return Rays(*(part[:count] for part in self))


def _no_rays(count: int) -> Rays:
    """Room for `count` rays."""
    place, way, weight = np.empty((3, count, 3), np.float32)
    return Rays(np.empty(count, np.int32), place, way, weight, np.empty(count, np.uint8))


def joined_surfaces(interfaces: list[Interface]) -> tuple[Mesh, Surfaces]:
    """Several interfaces as one mesh, and as arrays with the media on both sides of each of its triangles."""
    mesh = joined([interface.mesh for interface in interfaces])
    counts = [len(interface.mesh.faces) for interface in interfaces]
    media = [interface.inside for interface in interfaces] + [interface.outside for interface in interfaces]
    owner = np.repeat(np.arange(len(interfaces)), counts)
    return mesh, Surfaces(
        mesh.vertices.astype(np.float32),
        mesh.normals.astype(np.float32),
        mesh.faces.astype(np.int32),
        np.stack([owner, owner + len(interfaces)], axis=1).astype(np.int32),
        np.repeat([interface.is_liquid for interface in interfaces], counts),
        np.array([medium.refraction for medium in media], np.float32),
        np.array([medium.absorption for medium in media], np.float32),
    )


@dataclass(frozen=True)
class Seen:
    """What rays see: radiance [rays, 3]; whether each meets a glass, and whether its line of sight meets liquid."""

    radiance: Float[np.ndarray, "rays 3"]
    container: Bool[np.ndarray, " rays"]
    liquid: Bool[np.ndarray, " rays"]


def follow(
    surfaces: Surfaces,
    cast: Cast,
    light: Light,
    origins: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    *,
    turn: Int[np.ndarray, " rays"],
    turns: int,
    depth: int,
    dim: Float[np.ndarray, "3"],
) -> Seen:
    """Light and line of sight of primary rays.

    The line of sight of a ray is refracted on, or reflected where it is reflected totally, at up to `depth` surfaces;
    once the outside of the glass has reflected it totally it no longer says what the pixel shows. Beside it go the
    reflections: strong ones always, weak ones at each `turns`-th surface with `turns` times their share, in the rays
    whose number `turn` has come, so that the `turns` samples of a pixel take turns. dim [3]: radiance that stands for
    rays which are no longer followed.
    """
    count = len(origins)
    radiance, met = np.zeros((count, 3)), np.zeros(count, np.uint8)
    rays = Rays(
        np.arange(count, dtype=np.int32),
        np.ascontiguousarray(origins, np.float32),
        np.ascontiguousarray(directions, np.float32),
        np.ones((count, 3), np.float32),
        np.full(count, SIGHT, np.uint8),
    )
    turn = np.ascontiguousarray(turn, np.int32)
    dim = np.ascontiguousarray(dim, np.float64)
    for surface in range(depth):
        hits = cast(rays.place, rays.way)
        free, ahead = _no_rays(len(rays.owner)), _no_rays(2 * len(rays.owner))
        gone, on = _cross(rays, *hits, surfaces, surface, turn, turns, dim, radiance, met, free, ahead)
        free, rays = free.first(gone), ahead.first(on)
        _give(free, np.asarray(light(free.place, free.way), np.float64), radiance)
        if not on:
            break
    _give(rays, np.broadcast_to(dim, (len(rays.owner), 3)), radiance)
    return Seen(radiance, (met & CONTAINER) > 0, (met & LIQUID) > 0)


@njit(cache=True)
@no_type_check
def _give(rays, light, radiance):
    """Gives light [rays, 3] to the owners of the rays."""
    for i in range(len(rays.owner)):
        for c in range(3):
            radiance[rays.owner[i], c] += rays.weight[i, c] * light[i, c]


@njit(cache=True)
@no_type_check
def fresnel(cosine, ratio):
    """Share of unpolarised light that is reflected, and cosine of the refracted ray, at a surface.

    cosine: of the angle of incidence; ratio: index of the medium the ray comes from over that of the one it enters.
    (1, 0) for total reflection.
    """
    rest = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    if rest <= 0.0:
        return 1.0, 0.0
    beyond = math.sqrt(rest)
    across = (ratio * cosine - beyond) / (ratio * cosine + beyond)
    along = (cosine - ratio * beyond) / (cosine + ratio * beyond)
    return 0.5 * (across * across + along * along), beyond


@njit(cache=True)
@no_type_check
def _meet(place, way, f, u, v, surfaces, hit, smooth, flat):
    """Where a ray meets a triangle, and the normals there, turned against the ray; gives back whether it comes from
    outside."""
    i, j, k = surfaces.faces[f, 0], surfaces.faces[f, 1], surfaces.faces[f, 2]
    points, normals = surfaces.points, surfaces.normals
    w = 1.0 - u - v
    for c in range(3):
        hit[c] = w * points[i, c] + u * points[j, c] + v * points[k, c]
        smooth[c] = w * normals[i, c] + u * normals[j, c] + v * normals[k, c]
    ax, ay, az = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    bx, by, bz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
    flat[0], flat[1], flat[2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = math.sqrt(smooth[0] ** 2 + smooth[1] ** 2 + smooth[2] ** 2)
    area = math.sqrt(flat[0] ** 2 + flat[1] ** 2 + flat[2] ** 2)
    from_outside = way[0] * flat[0] + way[1] * flat[1] + way[2] * flat[2] < 0.0
    sign = 1.0 if from_outside else -1.0
    for c in range(3):
        smooth[c] *= sign / length
        flat[c] *= sign / area
    return from_outside


@njit(cache=True)
@no_type_check
def _push(rays, k, owner, hit, normal, leap, x, y, z, weight, share, state):
    """Writes ray number k, which starts `leap` along the normal away from `hit`."""
    length = math.sqrt(x * x + y * y + z * z)
    rays.owner[k], rays.state[k] = owner, state
    for c in range(3):
        rays.place[k, c] = hit[c] + leap * normal[c]
        rays.weight[k, c] = weight[c] * share
    rays.way[k, 0], rays.way[k, 1], rays.way[k, 2] = x / length, y / length, z / length


@njit(cache=True)
@no_type_check
def _cross(rays, face, us, vs, surfaces, surface, turn, turns, dim, radiance, met, free, ahead):
    """Takes all rays over the surfaces that they hit: fills `free` with those that hit nothing and `ahead` with those
    that go on, gives back how many these are."""
    hit, smooth, flat, weight = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    gone, on = 0, 0
    for i in range(len(rays.owner)):
        owner, state, f, way = rays.owner[i], rays.state[i], face[i], rays.way[i]
        if f < 0:
            _push(free, gone, owner, rays.place[i], way, 0.0, way[0], way[1], way[2], rays.weight[i], 1.0, state)
            gone += 1
            continue
        from_outside = _meet(rays.place[i], way, f, us[i], vs[i], surfaces, hit, smooth, flat)
        here, there = surfaces.sides[f, 1], surfaces.sides[f, 0]
        if not from_outside:
            here, there = there, here
        if state == SIGHT:
            met[owner] |= CONTAINER
            if surfaces.is_liquid[f] and surface < LIQUID_WITHIN:
                met[owner] |= LIQUID
        far, cosine, bright = 0.0, 0.0, 0.0
        for c in range(3):
            far += (hit[c] - rays.place[i, c]) ** 2
            cosine -= way[c] * smooth[c]
        far, cosine = math.sqrt(far), min(max(cosine, 1e-4), 1.0)  # the smooth normal may look away
        for c in range(3):
            weight[c] = rays.weight[i, c] * math.exp(-surfaces.absorption[here, c] * far)
            bright = max(bright, weight[c])
        ratio = surfaces.refraction[here] / surfaces.refraction[there]
        share, beyond = fresnel(cosine, ratio)
        bend = ratio * cosine - beyond
        tx, ty, tz = (
            ratio * way[0] + bend * smooth[0],
            ratio * way[1] + bend * smooth[1],
            ratio * way[2] + bend * smooth[2],
        )
        bx, by, bz = (
            way[0] + 2.0 * cosine * smooth[0],
            way[1] + 2.0 * cosine * smooth[1],
            way[2] + 2.0 * cosine * smooth[2],
        )
        reflects = share >= 1.0 or (state == SIDE and share > 0.5)
        if state != SIDE and not reflects and (share > STRONG or (turn[owner] + surface) % turns == 0):
            part = share if share > STRONG else share * turns
            if part * bright > FAINT:
                _push(ahead, on, owner, hit, flat, LEAP, bx, by, bz, weight, part, SIDE)
                on += 1
            else:
                for c in range(3):
                    radiance[owner, c] += part * weight[c] * dim[c]
        part = share if reflects else 1.0 - share
        if state == SIDE:  # its weaker part is not followed
            for c in range(3):
                radiance[owner, c] += (1.0 - part) * weight[c] * dim[c]
        if state == SIDE and part * bright <= FAINT:
            for c in range(3):
                radiance[owner, c] += part * weight[c] * dim[c]
        elif reflects:
            kept = BLIND if state == SIGHT and not surfaces.is_liquid[f] else state
            _push(ahead, on, owner, hit, flat, LEAP, bx, by, bz, weight, part, kept)
            on += 1
        else:
            _push(ahead, on, owner, hit, flat, -LEAP, tx, ty, tz, weight, part, state)
            on += 1
    return gone, on
