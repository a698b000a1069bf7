"""The outside of a glass from lines of sight at its edges, and the cavity that the told wall leaves inside of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from skimage.measure import approximate_polygon

from zsdt.errors import DataError
from zsdt.perception.glass_rays import moved_profile
from zsdt.perception.glass_sight import Sight
from zsdt.perception.told_glass import ToldGlass
from zsdt.scene import VesselFamily, VesselShape

PITCH = 1e-3  # m between the heights of a profile
WIDTH = 2e-3  # m over which it is smoothed
ROUNDS = 4  # of touching points and slope
STEEPEST = 0.8  # of the slope at which the wall turns its outline away from the camera
EDGE = 2e-3  # m at rim and foot that may be rounded: the profile is continued there
STRAIGHT = 1e-4  # m within which a profile is drawn as one line
CENTRAL = 0.25  # of the half-width: columns in which the rim's height is read


@dataclass(frozen=True)
class OuterProfile:
    """Half-widths along x [m] of a glass's outside at heights [m] above the table, from 0 to the rim; closed: whether
    the rim was seen."""

    heights: Float[np.ndarray, " points"]
    radii: Float[np.ndarray, " points"]
    closed: bool

    def ring(self, height: float, told: ToldGlass, count: int = 96) -> Float[np.ndarray, "count 3"]:
        """Points of the outside at a height [m], about the axis."""
        angle = 2.0 * np.pi * np.arange(count) / count
        half = float(np.interp(height, self.heights, self.radii))
        across = (half - told.wall) * told.aspect + told.wall if not told.is_round else half
        cos, sin = np.cos(angle), np.sin(angle)
        reach = (np.abs(cos) ** told.exponent + np.abs(sin) ** told.exponent) ** (-1.0 / told.exponent)
        return np.stack([half * reach * cos, across * reach * sin, np.full(count, height)], axis=1)


def outer_profile_of(
    sights: Sequence[Sight], told: ToldGlass, closed: bool, elsewhere: Sequence[Sight] = ()
) -> OuterProfile:
    """Median profile over some pictures.

    closed: whether the rim is in the picture; else the glass ends where the picture does. elsewhere: pictures in which
    the glass stands elsewhere, perhaps nearer or farther. They tell its shape, before another part of the background,
    and are brought to the size that it has in the others.
    Raises: DataError where the edges are of no glass.
    """
    nearest = [_nearest(sight) for sight in sights]
    if elsewhere and told.is_round:
        nearest += [_brought_to(nearest, _nearest(sight), float(sight.eye[2])) for sight in elsewhere]
    z, r, climb = (np.concatenate(parts) for parts in zip(*nearest, strict=True))
    if told.is_round:
        heights, radii = _round_profile(z, r, climb)
    else:
        heights = np.arange(0.0, z.max(), PITCH)
        half = float(np.median([np.mean(prism_half_widths(sight, told)) for sight in sights]))
        radii = np.full(len(heights), half + told.wall)
    rim = float(heights[-1])
    if closed:
        rim = float(np.median([_rim_height(sight, heights, radii) for sight in sights]))
    if not told.floor + 0.01 < rim < heights[-1] + 0.1:
        raise DataError(
            f"The outline of the glass ends {100 * rim:.1f} cm above the table, which is no glass with a floor of "
            f"{1000 * told.floor:g} mm; check the camera's distance and height, or the picture."
        )
    levels = np.concatenate([np.arange(0.0, rim - 0.5 * PITCH, PITCH), [rim]])
    inside = (heights >= EDGE) & (heights <= rim - EDGE)
    return OuterProfile(levels, _straight_on(levels, heights[inside], radii[inside]), closed)


def _nearest(
    sight: Sight,
) -> tuple[Float[np.ndarray, " edges"], Float[np.ndarray, " edges"], Float[np.ndarray, " edges"]]:
    """Height and distance [m] of the nearest approach to the axis of all lines of sight, and how steep they climb."""
    way = np.concatenate([sight.left, sight.right])
    eye = sight.eye - [sight.axis(), 0.0, 0.0]
    flat = np.hypot(way[:, 0], way[:, 1])
    length = -(way[:, 0] * eye[0] + way[:, 1] * eye[1]) / flat
    distance = np.abs(eye[0] * way[:, 1] - eye[1] * way[:, 0]) / flat
    climb = way[:, 2] / flat
    return eye[2] + length * climb, distance, climb


Edges = tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"], Float[np.ndarray, "_"]]  # of one picture


def _brought_to(here: Sequence[Edges], there: Edges, eye: float) -> Edges:
    """Edges of another picture [m] at the size of those here; the camera's height `eye` [m] is what stays."""
    z, r, climb = there
    own = np.concatenate([part[0] for part in here])
    order = np.argsort(own)
    expected = np.interp(z, own[order], np.concatenate([part[1] for part in here])[order])
    middle = (z > 0.2 * own.max()) & (z < 0.8 * own.max())
    size = float(np.median(expected[middle] / r[middle])) if middle.any() else 1.0
    return eye + size * (z - eye), size * r, climb


def _round_profile(
    z: Float[np.ndarray, " edges"], r: Float[np.ndarray, " edges"], climb: Float[np.ndarray, " edges"]
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Profile that all lines of sight touch. With q = slope of the profile times climb of the line of sight it touches
    q / sqrt(1 - q^2) of its nearest distance behind the nearest point."""
    heights = np.arange(0.0, z.max() + PITCH, PITCH)
    touched_z, touched_r, fair = z, r, np.ones(len(z), bool)
    for _ in range(ROUNDS):
        radii = _smooth(touched_z[fair], touched_r[fair], heights)
        slope = np.interp(touched_z, heights, np.gradient(radii, heights))
        q = slope * climb
        fair = np.abs(q) < STEEPEST
        q = np.clip(q, -STEEPEST, STEEPEST)
        lean = 1.0 / np.sqrt(1.0 - q * q)
        touched_z, touched_r = z + r * q * lean * climb, r * lean
    return heights, _smooth(touched_z[fair], touched_r[fair], heights)


def _smooth(
    z: Float[np.ndarray, " edges"], r: Float[np.ndarray, " edges"], heights: Float[np.ndarray, " points"]
) -> Float[np.ndarray, " points"]:
    """Medians of bins of half a pitch, and through them at each height a line weighted over `WIDTH`."""
    number = np.floor(z / (0.5 * PITCH)).astype(int)
    order = np.lexsort((r, number))
    number, z, r = number[order], z[order], r[order]
    cuts = np.flatnonzero(np.diff(number)) + 1
    middle_z = np.array([part.mean() for part in np.split(z, cuts)])
    middle_r = np.array([part[len(part) // 2] for part in np.split(r, cuts)])
    away = middle_z[None] - heights[:, None]
    weight = np.maximum(1.0 - (away / WIDTH) ** 2, 0.0) ** 2 + 1e-9 / (1.0 + (away / WIDTH) ** 4)
    total, first = weight.sum(1), (weight * away).sum(1)
    second = (weight * away**2).sum(1) + 1e-3 * total * WIDTH**2
    mean, moment = (weight * middle_r).sum(1), (weight * away * middle_r).sum(1)
    return (mean * second - moment * first) / (total * second - first**2)


def prism_half_widths(sight: Sight, told: ToldGlass) -> tuple[float, float]:
    """Half-width along x of the cavity [m] as the left and as the right edge have it.

    They differ by twice what the bisector misses of the axis: seen askew, a prism is not symmetric. The farthest
    tangent of a superellipse in a direction is its dual norm, of the exponent n / (n - 1).
    """
    z, distance, _ = _nearest(sight)
    way = np.concatenate([sight.left, sight.right])
    across = np.abs(way[:, :2][:, ::-1]) / np.hypot(way[:, 0], way[:, 1])[:, None]
    dual = told.exponent / (told.exponent - 1.0)
    low, high = np.zeros(len(way)), 3.0 * distance
    for _ in range(50):
        half = 0.5 * (low + high)
        outer = np.stack([half + told.wall, told.aspect * half + told.wall], axis=1)
        beyond = ((outer * across) ** dual).sum(1) ** (1.0 / dual) > distance
        low, high = np.where(beyond, low, half), np.where(beyond, half, high)
    middle = (z > 0.25 * z.max()) & (z < 0.75 * z.max())
    left = np.arange(len(way)) < len(sight.left)
    return float(np.median(half[middle & left])), float(np.median(half[middle & ~left]))


def _rim_height(sight: Sight, heights: Float[np.ndarray, " points"], radii: Float[np.ndarray, " points"]) -> float:
    """Height of the rim [m]: the far one for a camera above it, else the near one."""
    eye = sight.eye - [sight.axis(), 0.0, 0.0]
    away = float(np.hypot(eye[0], eye[1]))
    way = sight.top
    aside = np.abs(eye[0] * way[:, 1] - eye[1] * way[:, 0]) / np.hypot(way[:, 0], way[:, 1])
    central = aside < CENTRAL * radii.max()
    if not central.any():
        return float(heights[-1])
    climb = way[central, 2] / np.hypot(way[central, 0], way[central, 1])
    aside = aside[central]
    level = float(heights[-1])
    for _ in range(8):
        inside = (heights >= level - 12.0 * PITCH) & (heights <= level - 3.0 * PITCH)
        if inside.sum() < 4:
            return level
        radius = np.polyval(np.polyfit(heights[inside], radii[inside], 1), level)
        deep = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
        along = np.sqrt(np.maximum(away**2 - aside**2, 0.0))
        found = eye[2] + np.minimum((along + deep) * climb, (along - deep) * climb)
        level = 0.5 * (level + min(float(np.median(found)), float(heights[-1])))
    return level


def _straight_on(
    levels: Float[np.ndarray, " levels"], heights: Float[np.ndarray, " points"], radii: Float[np.ndarray, " points"]
) -> Float[np.ndarray, " levels"]:
    """Radii at levels; above the known ones continued straight, below them upright: a foot stands so."""
    if len(heights) < 6:
        raise DataError("The outline of the glass has too few rows; film it larger.")
    found = np.interp(levels, heights, radii)
    line = np.polyfit(heights[-5:], radii[-5:], 1)
    return np.maximum(np.where(levels > heights[-1], np.polyval(line, levels), found), 1e-3)


def as_shape(profile: OuterProfile, told: ToldGlass) -> VesselShape:
    """The cavity: the outside moved inwards by the wall, above the floor.

    Raises: DataError where the wall is thicker than the glass.
    """
    rim = float(profile.heights[-1]) - told.floor
    if not told.is_round:
        half = float(np.median(profile.radii)) - told.wall
        if half <= 0:
            raise DataError("The told wall is thicker than the glass; correct wall in the scene, in m.")
        return VesselShape(VesselFamily.jar, [0.0, rim], [half, half], told.aspect, told.exponent)
    z, r = moved_profile(profile.heights - told.floor, profile.radii, -told.wall)
    if r.min() <= 0:
        raise DataError("The told wall is thicker than the glass; correct wall in the scene, in m.")
    inside = (z > 0.5 * PITCH) & (z < rim - 0.5 * PITCH)
    levels = np.concatenate([[0.0], z[inside], [rim]])
    heights, radii = _few_points(levels, np.interp(levels, z, r))
    return VesselShape(_family(levels, np.interp(levels, z, r)), [float(h) for h in heights], [float(x) for x in radii])


def simplified(profile: OuterProfile) -> tuple[Float[np.ndarray, " kept"], Float[np.ndarray, " kept"]]:
    """Heights and radii [m] of the fewest points that tell the outside within `STRAIGHT`: without the slopes that noise
    makes, which would bend light."""
    return _few_points(profile.heights, profile.radii)


def _few_points(
    z: Float[np.ndarray, " points"], r: Float[np.ndarray, " points"]
) -> tuple[Float[np.ndarray, " kept"], Float[np.ndarray, " kept"]]:
    """Corners of a line of few pieces through a profile: chosen by Douglas and Peucker, radii by least squares."""
    corners = approximate_polygon(np.column_stack([z, r]), STRAIGHT)[:, 0]
    hats = np.stack([np.interp(z, corners, one) for one in np.eye(len(corners))], axis=1)
    return corners, np.linalg.lstsq(hats, r, rcond=None)[0]


def _family(heights: Float[np.ndarray, " points"], radii: Float[np.ndarray, " points"]) -> VesselFamily:
    """What a person would call a round profile."""
    line = np.polyval(np.polyfit(heights, radii, 1), heights)
    if np.ptp(radii) < 0.04 * radii.max():
        return VesselFamily.cylinder
    if np.abs(radii - line).max() < 0.04 * radii.max():
        return VesselFamily.tumbler
    low: Bool[np.ndarray, " points"] = heights < 0.3 * heights[-1]
    return VesselFamily.flask if np.ptp(radii[low]) < 0.1 * radii.max() else VesselFamily.bowl
