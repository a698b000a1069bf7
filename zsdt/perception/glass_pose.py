"""Angles and height of the camera, mended so that the outline's foot stands on the table and its rim is a level ring.

A told camera is a bit off, and a tenth of a degree moves the level of a liquid by a millimetre. Where the foot and the
rim of the glass are in the picture says more: their rings are level, the foot's at height 0, and the axis is upright.
Least squares over pitch, roll, height and rim, with the told values as a prior; the distance stays as told, because no
silhouette tells a near small glass from a far large one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from zsdt.perception.camera import Camera
from zsdt.perception.glass_profile import OuterProfile
from zsdt.perception.glass_sight import Outline, outline_of
from zsdt.perception.mask_edges import MaskEdges
from zsdt.perception.told_glass import ToldGlass

PICTURES = 4  # that are looked at, spread over those given
SPREAD = 0.8  # of the half-width: columns of rim and foot that are compared
COLUMNS = 15
SHARPNESS = 0.6  # px: how well an outline is known
# Independent values that foot, rim and axis are worth: errors of an outline hang together, but those of its two sides
# do not, so the axis between them is sharp.
WORTH = (1.5, 1.5, 40.0)
RIM_DOUBT = 0.005  # m


def turned_camera(camera: Camera, pitch: float, roll: float, lift: float) -> Camera:
    """The camera turned about its own axes by `pitch` (downwards) and `roll` [rad], and lifted [m]."""
    turn = cv2.Rodrigues(np.array([pitch, 0.0, 0.0]))[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    rotation = turn @ camera.rotation
    return replace(camera, rotation=rotation, translation=-rotation @ (camera.center + np.array([0.0, 0.0, lift])))


def mended_camera(
    edges: Sequence[MaskEdges], camera: Camera, profile: OuterProfile, told: ToldGlass
) -> tuple[Camera, dict[str, float]]:
    """The camera in whose eyes the glass stands upright on the table, and notes: pitch, roll [rad] and lift [m] by
    which it differs from the told one, and what is left of the differences at foot, rim and axis [px]."""
    chosen = [edges[k] for k in np.unique(np.linspace(0, len(edges) - 1, PICTURES).astype(int))]
    outlines_seen = [outline_of(e, camera) for e in chosen]
    prior = np.array([told.camera_doubt, told.camera_doubt, told.height_doubt, RIM_DOUBT])

    def outlines(change: Float[np.ndarray, "4"]) -> list[Float[np.ndarray, " values"]]:
        turned = turned_camera(camera, change[0], change[1], change[2])
        return [np.concatenate(parts) for parts in zip(*(
            _differences(e, outline, turned, profile, told, change[3])
            for e, outline in zip(chosen, outlines_seen, strict=True)), strict=True)]  # fmt: skip

    def residuals(scaled: Float[np.ndarray, "4"]) -> Float[np.ndarray, " values"]:
        parts = [
            np.sqrt(worth / max(len(p), 1)) / SHARPNESS * p
            for worth, p in zip(WORTH, outlines(scaled * prior), strict=True)
        ]
        return np.concatenate([*parts, scaled])

    def about_ones(ones: Float[np.ndarray, "4"]) -> Float[np.ndarray, " values"]:
        """The steps of differences are shares of the values, so these should not be zeros."""
        return residuals(ones - 1.0)

    ones = least_squares(about_ones, np.ones(4), loss="soft_l1", max_nfev=12, diff_step=np.full(4, 0.05)).x
    found = (ones - 1.0) * prior
    left = [float(np.sqrt(np.mean(p**2))) if len(p) else 0.0 for p in outlines(found)]
    notes = dict(zip(("foot_px", "rim_px", "axis_px"), left, strict=True))
    notes |= {"pitch": float(found[0]), "roll": float(found[1]), "lift": float(found[2])}
    return turned_camera(camera, found[0], found[1], found[2]), notes


def _differences(
    edges: MaskEdges, outline: Outline, camera: Camera, profile: OuterProfile, told: ToldGlass, raised: float
) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"], Float[np.ndarray, " c"]]:
    """Seen less expected [px]: foot, rim (raised by some m), and the axis over the height."""
    sight = outline.seen_by(camera)
    x = sight.axis()
    foot = _arc(profile.ring(0.0, told), camera, x, edges.columns, edges.bottom, told.foot_edge, lower=True)
    rim = np.zeros(0)
    if profile.closed:
        ring = profile.ring(float(profile.heights[-1]), told) + np.array([0.0, 0.0, raised])
        rim = _arc(ring, camera, x, edges.columns, edges.top, 0.5 * told.wall, lower=False)
    angle = sight.bisectors()
    off = camera.matrix[0, 0] * (np.tan(angle) - (x - sight.eye[0]) / -sight.eye[1])
    off = off[len(off) // 8 : -(len(off) // 8) or None]  # at foot and rim the two sides are no pair
    count = len(off) // 10
    lean = np.median(off[: count * 10].reshape(10, count), axis=1) if count else np.zeros(0)
    return foot, rim, lean


def _arc(
    ring: Float[np.ndarray, "points 3"],
    camera: Camera,
    x: float,
    columns: Float[np.ndarray, " columns"],
    seen: Float[np.ndarray, " columns"],
    rounding: float,
    lower: bool,
) -> Float[np.ndarray, " compared"]:
    """Seen edge less the lower or upper half of a ring in the picture [px], at some columns around its middle.

    A ring that is rounded off with a radius [m] is seen nearer to its middle by radius * (sin + cos - 1) of the angle
    at which the camera looks down on it.
    """
    placed = ring + np.array([x, 0.0, 0.0])
    pixels = camera.project(placed)
    middle_point = placed.mean(axis=0)
    way = middle_point - camera.center
    down = abs(np.arctan2(way[2], np.hypot(way[0], way[1])))
    short = rounding * (np.sin(down) + np.cos(down) - 1.0)
    short *= camera.matrix[1, 1] / float(camera.depths(middle_point[None])[0])
    left, right = pixels[:, 0].argmin(), pixels[:, 0].argmax()
    middle, half = 0.5 * (pixels[left, 0] + pixels[right, 0]), 0.5 * (pixels[right, 0] - pixels[left, 0])
    at = middle + SPREAD * half * np.linspace(-1.0, 1.0, COLUMNS)
    on = pixels[left, 1] + (pixels[:, 0] - pixels[left, 0]) / (2.0 * half) * (pixels[right, 1] - pixels[left, 1])
    side = pixels[(pixels[:, 1] > on) == lower]
    side = side[np.argsort(side[:, 0])]
    fair = np.isfinite(seen)
    if len(side) < 3 or fair.sum() < 3:
        return np.zeros(0)
    difference = np.interp(at, columns[fair], seen[fair]) - np.interp(at, side[:, 0], side[:, 1])
    return np.asarray(difference + (short if lower else -short))
