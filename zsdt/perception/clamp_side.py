"""On which side the beam is held: at which end a block stands across it, and at which end it is bent and upright.

Two tests that know nothing of each other. One may be undecided; if they contradict each other the user is asked.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsdt.errors import DataError
from zsdt.perception.camera import ClampSide

CLEAR_BLOCK = 8.0  # grey levels by which one end must look more like a clamp if the beam's shape says the same
SURE_BLOCK = 25.0  # ... and if its shape says nothing
HINT = 2.5  # ratio of the bending at both ends that at least suggests a side
BENT = 0.012  # rad per pitch by which the beam must be bent more at one end
UPRIGHT = 0.1  # rad by which the other end column must lean more
HANGING = 0.25  # rad of lean that no view of a straight beam explains

Grid = Float[np.ndarray, "columns rows 2"]


def find_clamp_side(
    pixels: Grid, found: Bool[np.ndarray, "columns rows"], image: UInt8[np.ndarray, "h w 3"] | None
) -> ClampSide:
    """Side of the clamp of a grid with columns from left to right and rows upwards [px].

    Raises: DataError where the tests contradict each other or none of them can tell.
    """
    posture = posture_side(pixels, found)
    suggested = posture or _suggested_side(pixels)
    block = None if image is None else block_side(pixels, image, suggested)
    if block is not None and posture is not None and block is not posture:
        raise DataError(
            f"The clamp's side is unclear: a block stands at the {block.value} end, but the beam is bent as if it were "
            f"held at the {posture.value}. Say clamp_side=left or clamp_side=right."
        )
    side = block or posture
    if side is None:
        raise DataError(
            "The clamp's side is unclear: no block stands at one end only, and the beam is too straight to tell. "
            "Say clamp_side=left or clamp_side=right."
        )
    return side


def block_side(pixels: Grid, image: UInt8[np.ndarray, "h w 3"], suggested: ClampSide | None = None) -> ClampSide | None:
    """The end beside which a clamp stands; None where the two ends look too much alike.

    A weak difference counts only at the end that the beam's shape suggests.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.5).astype(np.float64)
    left, right = block_score(pixels, smooth), block_score(pixels[::-1], smooth)
    side = ClampSide.left if left > right else ClampSide.right
    return side if abs(left - right) >= (CLEAR_BLOCK if side is suggested else SURE_BLOCK) else None


def block_score(pixels: Grid, image: Float[np.ndarray, "h w 3"]) -> float:
    """How much column 0 looks held [grey levels].

    A clamp is of one colour beside the end and reaches above and below it, where it ends at the wall. So: the smaller
    of the colour steps at the upper and lower corner, from beside the beam to over and under it, less the unevenness
    of what is beside it. A bare end has the same wall on both sides of its corners; a side face of the beam that the
    camera sees makes a step at one of them only.
    """
    inward = pixels[1] - pixels[0]
    up = np.gradient(pixels[0], axis=0)
    low, high = pixels[0, 0] - 0.12 * up[0], pixels[0, -1] + 0.12 * up[-1]
    along = np.concatenate([[low], pixels[0], [high]])
    away = np.concatenate([inward[:1], inward, inward[-1:]])
    levels = np.linspace(0, len(along) - 1, 4 * len(along))
    line, off = (
        np.stack([np.interp(levels, np.arange(len(along)), part[:, k]) for k in (0, 1)], axis=-1)
        for part in (along, away)
    )
    beside = _colours(image, line[:, None] - np.linspace(0.15, 0.45, 6)[:, None] * off[:, None])
    uneven = float(_usual(np.abs(beside - _usual(beside)).max(axis=-1, keepdims=True))[0])
    steps = []
    for corner, out, inside, end in ((0, -up[0], inward[0], slice(0, 4)), (-1, up[-1], inward[-1], slice(-4, None))):
        # Wide enough to look past the cheek of the clamp.
        over = np.linspace(0.1, 0.2, 3)[:, None, None] * out + np.linspace(0.3, 2.2, 12)[:, None] * inside
        wall = _usual(_colours(image, pixels[0, corner] + over))
        steps.append(float(np.abs(wall - _usual(beside[end])).max()))  # light may change along a clamp
    seen = [step for step in steps if np.isfinite(step)]  # the others lie outside of the picture
    return min(seen) - 2.0 * uneven if seen and np.isfinite(uneven) else 0.0


def posture_side(pixels: Grid, found: Bool[np.ndarray, "columns rows"]) -> ClampSide | None:
    """The held end from the shape alone; None where it does not tell.

    A cantilever is bent most at its clamp and not at all at its tip, and its tip's column turns with it.
    """
    bent, lean = end_bending(pixels), end_lean(pixels, found)
    if abs(lean[0] - lean[1]) > HANGING:
        return ClampSide.left if lean[0] < lean[1] else ClampSide.right
    votes = [
        None if abs(a - b) < limit else (ClampSide.left if (a > b) is larger else ClampSide.right)
        for (a, b), limit, larger in ((bent, BENT, True), (lean, UPRIGHT, False))
    ]
    sides = {vote for vote in votes if vote is not None}
    return sides.pop() if len(sides) == 1 else None


def _suggested_side(pixels: Grid) -> ClampSide | None:
    """The end that is bent several times as much, however little that is."""
    left, right = end_bending(pixels)
    if max(left, right) < 0.002 or max(left, right) < HINT * min(left, right):
        return None
    return ClampSide.left if left > right else ClampSide.right


def end_bending(pixels: Grid) -> tuple[float, float]:
    """Curvature of the rows in the third at the left and at the right end [rad per pitch]; their mean, without sign."""
    columns = len(pixels)
    if columns < 5:
        return 0.0, 0.0
    step = np.diff(pixels.mean(axis=1), axis=0)
    turn = np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
    third = max(2, len(turn) // 3)
    return abs(float(turn[:third].mean())), abs(float(turn[-third:].mean()))


def end_lean(pixels: Grid, found: Bool[np.ndarray, "columns rows"]) -> tuple[float, float]:
    """Angle of the left and the right end column from the vertical [rad]."""
    lean = []
    for end in (0, -1):
        seen = pixels[end][found[end]] if found[end].sum() >= 2 else pixels[end]
        across = seen[-1] - seen[0]
        lean.append(abs(float(np.arctan2(across[0], -across[1]))))
    return lean[0], lean[1]


def _usual(colours: Float[np.ndarray, "*any channels"]) -> Float[np.ndarray, " channels"]:
    """Median of the colours that are known; NaN where none is."""
    flat = colours.reshape(-1, colours.shape[-1])
    known = flat[np.isfinite(flat).all(axis=1)]
    return np.median(known, axis=0) if len(known) else np.full(flat.shape[1], np.nan)


def _colours(image: Float[np.ndarray, "h w 3"], places: Float[np.ndarray, "*any 2"]) -> Float[np.ndarray, "*any 3"]:
    """Colours at pixels; NaN outside of the picture."""
    h, w = image.shape[:2]
    u, v = np.rint(places[..., 0]).astype(int), np.rint(places[..., 1]).astype(int)
    inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
    return np.where(inside[..., None], image[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)], np.nan)
