"""The fast camera of the glass lab: real refraction along single lines of sight, no chance, exact masks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.lab.beam_painter import shaken
from zsdt.lab.glass_rays import SHADE, Room, paint_glass, paint_room
from zsdt.lab.glass_scenery import light_of, room_of, with_feet
from zsdt.lab.glass_solid import solid_of
from zsdt.lab.glass_styles import GlassStyle
from zsdt.lab.glass_view import Glass, GlassView, Shot, outer_profile
from zsdt.lab.raster import bounding_box
from zsdt.perception.camera import Camera

# Pixels at the border of a mask are seen along these further lines of sight [px].
WITHIN = ((-0.25, 0.25), (0.25, 0.25), (0.25, -0.25), (-0.25, -0.25))
STRIDE = 8  # px between rays that are computed without an approximation
SLIVER = 0.05  # of the area of the largest part of a liquid
MARGIN = 3  # px around the outline of a glass


@dataclass(frozen=True)
class _Lens:
    """What a camera of one lens and size sees: rays [height, width, 3] of unit length in its own frame."""

    camera: Camera
    rays: Float[np.ndarray, "height width 3"]


def _lens(camera: Camera) -> _Lens:
    """Rays of all pixels; lenses are smooth, so that those of every eighth pixel tell the others."""
    u, v = np.arange(0, camera.width + STRIDE, STRIDE), np.arange(0, camera.height + STRIDE, STRIDE)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2).astype(np.float64)
    coarse = camera.normalise(pixels).reshape(len(v), len(u), 2)
    x, y = np.arange(camera.width) / STRIDE, np.arange(camera.height) / STRIDE
    i, j = x.astype(int), y.astype(int)
    across = coarse[:, i] + (x - i)[:, None] * (coarse[:, i + 1] - coarse[:, i])
    flat = across[j] + (y - j)[:, None, None] * (across[j + 1] - across[j])
    rays = np.concatenate([flat, np.ones((camera.height, camera.width, 1))], axis=2)
    return _Lens(camera, rays / np.linalg.norm(rays, axis=2, keepdims=True))


@dataclass(frozen=True)
class _Empty:
    """The room as a shaken camera sees it without glasses: rays [height, width, 3] in the room, picture."""

    style: GlassStyle
    shake: Float[np.ndarray, "3"]
    rays: Float[np.ndarray, "height width 3"]
    picture: Float[np.ndarray, "height width 3"]


class GlassPainter:
    """Paints views of glasses (`zsdt.lab.glass_view.GlassPicture`).

    The room without glasses is kept while style, camera and shake stay the same; only what lies around the glasses is
    painted in every view.
    """

    def __init__(self) -> None:
        self._style: GlassStyle | None = None
        self._room: Room | None = None
        self._seen: _Lens | None = None
        self._empty: _Empty | None = None

    def __call__(self, view: GlassView) -> Shot:
        """The picture of a view."""
        room = self._room_of(view)
        camera = shaken(view.camera, view.shake)
        empty = self._without_glasses(view, camera, room)
        picture = empty.picture.copy()
        height, width = picture.shape[:2]
        for glass, foot in zip(view.glasses, room.feet, strict=True):
            self._shade(glass, float(foot[2]), camera, room, empty.rays, picture)
        container: np.ndarray = np.zeros((height, width), np.uint8)
        liquid = np.zeros_like(container)
        for glass in view.glasses:
            self._add(glass, camera, room, empty.rays, picture, container, liquid)
        picture *= light_of(view.style, width, height)
        image: np.ndarray = picture.astype(np.float32)
        if view.style.blur > 0.2:
            image = cv2.GaussianBlur(image, (0, 0), view.style.blur)
        return Shot(np.clip(image, 0.0, 255.0), container, liquid)

    def _without_glasses(self, view: GlassView, camera: Camera, room: Room) -> _Empty:
        """The room without glasses and their shadows."""
        if self._seen is None or self._seen.camera is not view.camera:
            self._seen, self._empty = _lens(view.camera), None
        if self._empty is None or self._empty.style is not view.style or (self._empty.shake != view.shake).any():
            rays = self._seen.rays @ camera.rotation  # in the axes of the room
            picture = np.zeros(rays.shape)
            paint_room(rays.reshape(-1, 3), camera.center, with_feet(room, ()), picture.reshape(-1, 3))
            self._empty = _Empty(view.style, np.array(view.shake), rays, picture)
        return self._empty

    @staticmethod
    def _shade(
        glass: Glass,
        radius: float,
        camera: Camera,
        room: Room,
        rays: Float[np.ndarray, "height width 3"],
        picture: Float[np.ndarray, "height width 3"],
    ) -> None:
        """Paints the table around a glass anew, with the shadows."""
        angle = np.linspace(0.0, 2.0 * np.pi, 33)
        ring = SHADE * radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(33)], axis=1)
        at = np.asarray(glass.origin) * [1.0, 1.0, 0.0]
        left, top, right, bottom = bounding_box(camera.project(ring + at), (camera.width, camera.height), MARGIN)
        if right > left and bottom > top:
            part = np.s_[top:bottom, left:right]
            here = np.ascontiguousarray(rays[part]).reshape(-1, 3)
            colour = np.zeros_like(here)
            paint_room(here, camera.center, room, colour)
            picture[part] = colour.reshape(bottom - top, right - left, 3)

    def _room_of(self, view: GlassView) -> Room:
        if self._room is None or self._style is not view.style:
            self._style, self._room = view.style, room_of(view.style)
        return with_feet(self._room, view.glasses)

    def _add(
        self,
        glass: Glass,
        camera: Camera,
        room: Room,
        rays: Float[np.ndarray, "height width 3"],
        picture: Float[np.ndarray, "height width 3"],
        container: UInt8[np.ndarray, "height width"],
        liquid: UInt8[np.ndarray, "height width"],
    ) -> None:
        """Paints a glass into a picture and its masks."""
        left, top, right, bottom = _box(glass, camera)
        if right <= left or bottom <= top:
            return
        part = np.s_[top:bottom, left:right]
        shape = (bottom - top, right - left)
        solid, origin = solid_of(glass), np.asarray(glass.origin, np.float64)
        colour = np.ascontiguousarray(picture[part]).reshape(-1, 3)
        here = np.ascontiguousarray(rays[part]).reshape(-1, 3)
        labels = np.zeros(len(here), np.int64)
        paint_glass(here, camera.center, solid, room, origin, colour, labels)
        border = _border(labels.reshape(shape)).ravel()
        if border.any():
            cover = self._refine(border, camera, (left, top, shape[1]), solid, room, origin, colour)
        else:
            cover = np.zeros((0, 2))
        parts = np.stack([labels > 0, labels == 2], axis=1).astype(np.float64)
        parts[border] = cover
        picture[part] = colour.reshape(*shape, 3)
        levels = np.rint(255.0 * parts).astype(np.uint8).reshape(*shape, 2)
        container[part] = np.maximum(container[part], levels[..., 0])
        liquid[part] = np.maximum(liquid[part], without_slivers(levels[..., 1]))

    @staticmethod
    def _refine(
        border: np.ndarray,
        camera: Camera,
        frame: tuple[int, int, int],
        solid: object,
        room: Room,
        origin: np.ndarray,
        colour: np.ndarray,
    ) -> Float[np.ndarray, "pixels 2"]:
        """Sees pixels at the border of a mask along more lines of sight; gives back the covers, 0 to 1."""
        left, top, wide = frame
        where = np.flatnonzero(border)
        pixels = np.stack([left + where % wide, top + where // wide], axis=1).astype(np.float64)
        total, cover = np.zeros((len(where), 3)), np.zeros((len(where), 2))
        for offset in WITHIN:
            flat = camera.normalise(pixels + offset)
            rays = np.column_stack([flat, np.ones(len(flat))]) @ camera.rotation
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            seen, labels = np.zeros((len(where), 3)), np.zeros(len(where), np.int64)
            paint_room(rays, camera.center, room, seen)
            paint_glass(rays, camera.center, solid, room, origin, seen, labels)
            total += np.minimum(seen, 255.0)
            cover += np.stack([labels > 0, labels == 2], axis=1)
        colour[where] = total / len(WITHIN)
        return cover / len(WITHIN)


def without_slivers(mask: UInt8[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width"]:
    """The cover of a liquid without the thin lines and specks of it that rounded rims and feet show by guided light:
    parts narrower than three pixels, and those of less than `SLIVER` of the area of the largest."""
    core = cv2.erode((mask > 127).astype(np.uint8), np.ones((3, 3), np.uint8))
    count, labels, figures, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    if count < 2:
        return mask
    area = figures[:, cv2.CC_STAT_AREA]
    keep = (area >= SLIVER * area[1:].max()) & (np.arange(count) > 0)
    near = cv2.dilate(keep[labels].astype(np.uint8), np.ones((7, 7), np.uint8))
    return np.where(near > 0, mask, np.uint8(0))


def _box(glass: Glass, camera: Camera) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) px, half open, of the part of the picture that a glass may cover."""
    heights, radii = outer_profile(glass.vessel, glass.wall, glass.floor)
    deep = radii + (glass.vessel.aspect - 1.0) * glass.vessel.radii[0]
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    # A box around the cross-section holds superellipses as well.
    swell = 1.0 if glass.vessel.is_round else 2.0**0.5
    ring = np.stack([swell * np.cos(angle), swell * np.sin(angle)], axis=1)
    points = np.concatenate(
        [np.column_stack([ring * [r, d], np.full(len(ring), z)]) for z, r, d in zip(heights, radii, deep, strict=True)]
    )
    pixels = camera.project(points + glass.origin)
    return bounding_box(pixels, (camera.width, camera.height), MARGIN)


def _border(labels: np.ndarray) -> np.ndarray:
    """Pixels with a neighbour of another label."""
    different = np.zeros(labels.shape, bool)
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        changes = labels[a] != labels[b]
        different[a] |= changes
        different[b] |= changes
    return different
