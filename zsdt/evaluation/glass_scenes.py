"""Masks of a known glass with a known free surface before a known camera: the truth that the geometry is held against.

Every pixel's line of sight is traced through the wall of the glass (`zsdt.perception.glass_rays`) with any surface that
is level into the depth; edges are sampled finer. No picture is painted: this tests geometry alone, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numba import njit

from zsdt.lab.beam_painter import shaken
from zsdt.perception.camera import Camera
from zsdt.perception.glass_rays import FAR, MISSED, NEAR, STEP, GlassWalls, sight
from zsdt.perception.glass_sight import rays
from zsdt.scene import VesselShape

FINE = 4  # samples along each side of a pixel at an edge
MARCH = 24  # points of a line of sight through the air in the cavity
MARGIN = 6  # px around the glass
RINGS, SUPER = 40, 4  # of an outline, and how many times finer it is drawn


@dataclass(frozen=True)
class GlassScene:
    """A glass with a surface z = sum_k surface[k] x^k [m] in the axes of the vessel, whose axis is at x [m].

    wall, floor [m] of glass, index of the glass. camera: in the room (see `zsdt.perception.glass_geometry`).
    """

    shape: VesselShape
    surface: Float[np.ndarray, " powers"]
    camera: Camera
    wall: float = 0.002
    floor: float = 0.006
    index: float = 1.5
    x: float = 0.0

    def height(self, x: Float[np.ndarray, " places"]) -> Float[np.ndarray, " places"]:
        """Height of the surface [m] at places x [m]."""
        return np.asarray(np.polynomial.polynomial.polyval(x, self.surface))


def side_camera(
    distance: float = 0.5,
    height: float = 0.16,
    look_down: float = 0.2,
    focal: float = 1100.0,
    size: tuple[int, int] = (640, 400),
    roll: float = 0.0,
    distortion: Float[np.ndarray, "5"] | None = None,
) -> Camera:
    """A camera `distance` [m] in front of the plane y = 0 and `height` [m] above the table, turned down by `look_down`
    and about its axis by `roll` [rad]."""
    c, s = np.cos(look_down), np.sin(look_down)
    straight = np.array([[1.0, 0.0, 0.0], [0.0, -s, -c], [0.0, c, -s]])
    turn = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    rotation = turn @ straight
    width, tall = size
    return Camera(
        matrix=np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (tall - 1)], [0.0, 0.0, 1.0]]),
        distortion=np.zeros(5) if distortion is None else distortion,
        rotation=rotation,
        translation=-rotation @ np.array([0.0, -distance, height]),
        width=width,
        height=tall,
    )


@njit(cache=True, error_model="numpy")
@no_type_check
def _excess_height(surface, x, z):
    """z less the height of the surface at x [m]."""
    height = 0.0
    for k in range(len(surface) - 1, -1, -1):
        height = height * x + surface[k]
    return z - height


@njit(cache=True, error_model="numpy")
@no_type_check
def _labels(low, outer, inner, ratio_out, ratio_in, exponent, rim, floor, index, eye, way, surface, out):
    """0 background, 1 glass, 2 liquid for each line of sight."""
    for i in range(len(way)):
        dx, dy, dz = way[i, 0], way[i, 1], way[i, 2]
        out[i] = 0
        if not _hits_glass(low, outer, ratio_out, exponent, rim, floor, eye, dx, dy, dz):
            continue
        out[i] = 1
        met, near, far, _ = sight(
            low, outer, inner, ratio_out, ratio_in, exponent, rim, index, eye[0], eye[1], eye[2], dx, dy, dz
        )
        if met == MISSED:
            continue
        if met in (NEAR, FAR) and _excess_height(surface, near[0], near[2]) < 0.0:
            out[i] = 2
            continue
        if met >= FAR:
            for k in range(MARCH + 1):
                s = k / MARCH
                x, z = near[0] + s * (far[0] - near[0]), near[2] + s * (far[2] - near[2])
                if z < rim and _excess_height(surface, x, z) < 0.0:
                    out[i] = 2
                    break


@njit(cache=True, error_model="numpy")
@no_type_check
def _hits_glass(low, outer, ratio, exponent, rim, floor, eye, dx, dy, dz):
    """Whether a line of sight meets the solid between foot and rim (the opening counts as glass)."""
    from_z, to_z = -floor, rim
    if abs(dz) < 1e-12:
        return False
    a, b = (from_z - eye[2]) / dz, (to_z - eye[2]) / dz
    first, last = min(a, b), max(a, b)
    horizontal = dx * dx + dy * dy
    closest = -(eye[0] * dx + eye[1] * dy) / horizontal
    size = 2.0 * max(outer.max(), outer.max() * ratio)
    first, last = max(first, closest - size), min(last, closest + size)
    if last <= first:
        return False
    for k in range(65):
        s = first + (last - first) * k / 64
        x, y, z = eye[0] + s * dx, eye[1] + s * dy, eye[2] + s * dz
        f = (z - low) / 5e-4
        j = min(max(int(f), 0), len(outer) - 2)
        f = min(max(f - j, 0.0), 1.0)
        r = outer[j] + f * (outer[j + 1] - outer[j])
        if exponent == 2.0 and ratio == 1.0:
            if x * x + y * y < r * r:
                return True
        elif (abs(x) / r) ** exponent + (abs(y) / (ratio * r)) ** exponent < 1.0:
            return True
    return False


def masks(scene: GlassScene) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Cover 0 to 255 of the container (with the liquid) and of the apparent liquid in the picture of a scene."""
    camera = scene.camera
    walls = GlassWalls.of(scene.shape, scene.wall, scene.floor, scene.index)
    origin = np.array([scene.x, 0.0, scene.floor])
    corners = _box(walls, scene)
    pixels = camera.project(corners + origin)
    u0, v0 = np.maximum(np.floor(pixels.min(0)).astype(int) - MARGIN, 0)
    u1, v1 = np.minimum(np.ceil(pixels.max(0)).astype(int) + MARGIN, [camera.width - 1, camera.height - 1])
    container = np.zeros((camera.height, camera.width), np.uint8)
    liquid = np.zeros_like(container)
    if u1 < u0 or v1 < v0:
        return container, liquid
    u, v = np.meshgrid(np.arange(u0, u1 + 1.0), np.arange(v0, v1 + 1.0))
    coarse = _trace(scene, walls, origin, np.column_stack([u.ravel(), v.ravel()])).reshape(u.shape)
    low, high = (_around(coarse, f) for f in (np.minimum, np.maximum))
    edge = low != high
    cover = np.stack([255.0 * (coarse >= 1), 255.0 * (coarse >= 2)])
    shift = (np.arange(FINE) + 0.5) / FINE - 0.5
    du, dv = (a.ravel() for a in np.meshgrid(shift, shift))
    points = np.column_stack([(u[edge][:, None] + du).ravel(), (v[edge][:, None] + dv).ravel()])
    fine = _trace(scene, walls, origin, points).reshape(-1, FINE * FINE)
    for k in range(2):
        cover[k][edge] = 255.0 * (fine >= k + 1).mean(axis=1)
        (container, liquid)[k][v0 : v1 + 1, u0 : u1 + 1] = np.rint(cover[k]).astype(np.uint8)
    return container, liquid


def _box(walls: GlassWalls, scene: GlassScene) -> Float[np.ndarray, "8 3"]:
    half = float(walls.outer.max())
    x, y, z = np.meshgrid([-half, half], [-half * walls.ratio[0], half * walls.ratio[0]], [-scene.floor, walls.rim])
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)


def _around(values: np.ndarray, choose: np.ufunc) -> np.ndarray:
    """Least or greatest value of a pixel and its eight neighbours."""
    padded = np.pad(values, 1, mode="edge")
    h, w = values.shape
    out = values
    for a in range(3):
        for b in range(3):
            out = choose(out, padded[a : a + h, b : b + w])
    return out


def _trace(
    scene: GlassScene, walls: GlassWalls, origin: Float[np.ndarray, "3"], pixels: Float[np.ndarray, "points 2"]
) -> np.ndarray:
    out = np.zeros(len(pixels), np.int64)
    _labels(
        walls.low, walls.outer, walls.inner, *walls.ratio, walls.exponent, walls.rim, scene.floor, walls.index,
        scene.camera.center - origin, rays(scene.camera, pixels), np.asarray(scene.surface, np.float64), out,
    )  # fmt: skip
    return out


def outline_mask(
    shape: VesselShape,
    wall: float,
    floor: float,
    origin: Float[np.ndarray, "3"],
    camera: Camera,
    shake: Float[np.ndarray, "3"] | None = None,
) -> UInt8[np.ndarray, "h w"]:
    """Cover 0 to 255 of the outline of a glass whose cavity's floor is at `origin` [m], drawn from rings: cheap.

    shake [3] rad: rotation of the camera about itself.
    """
    walls = GlassWalls.of(shape, wall, floor, 1.5)
    heights = np.linspace(-floor, shape.rim, RINGS)
    half = np.interp(heights, walls.low + STEP * np.arange(len(walls.outer)), walls.outer)
    angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    cos, sin = np.cos(angle), np.sin(angle)
    reach = (np.abs(cos) ** walls.exponent + np.abs(sin) ** walls.exponent) ** (-1.0 / walls.exponent)
    ring = np.stack([reach * cos, walls.ratio[0] * reach * sin, np.zeros(72)], axis=1)
    points = (half[:, None, None] * ring + heights[:, None, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)
    pixels = shaken(camera, shake).project(points + origin).reshape(RINGS, 72, 2)
    fine = np.zeros((camera.height * SUPER, camera.width * SUPER), np.uint8)
    corners = np.rint(((pixels + 0.5) * SUPER - 0.5) * 16.0).astype(np.int32)
    for low, high in pairwise(corners):
        cv2.fillConvexPoly(fine, cv2.convexHull(np.concatenate([low, high])), 255, shift=4)
    return np.asarray(cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)
