"""By how many pixels a picture has moved because its camera has: what stands around the glass tells.

A glass that moves does so before a background that stays; when the camera turns, both move alike. Corners of an
earlier picture outside of the glass are looked for again where they were, and where they would be if the camera had
taken the glass along; the guess that finds more of them is right. For the small turns of a hand or a bumped tripod a
rotation is a shift of the whole picture.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsdt.perception.glass_window import Box

WIDTH = 320  # px of the pictures that are compared
CORNERS, APART, QUALITY = 80, 7, 0.02  # how many, px between them, share of the best one's strength
AROUND = 0.12  # of the size of the glass, around it: what counts as the glass
PATCH = 13  # px of what is compared at a corner
LIKE = 14.0  # grey levels of mean difference that a corner found again may have
AGREED = 1.0  # px (of the small picture) from the median of all
FEWEST, SHARE = 8, 0.35  # corners that must agree, and share of those in view
STEADY = 1.0  # px: less is the trembling of any camera, and the noise of this measurement


class CameraTurn:
    """Shift (u, v) [px] of each picture since the first; `update` picture by picture."""

    def __init__(self) -> None:
        self._key: UInt8[np.ndarray, "h w"] | None = None
        self._corners = np.zeros((0, 2), np.float32)
        self._home = Box(0, 0, 0, 0)
        self._latest = np.zeros(2)

    def update(self, image: UInt8[np.ndarray, "h w 3"], glass: Box) -> Float[np.ndarray, "2"]:
        """Shift [px] of a picture in which the glass is seen in a box; (0, 0) where nothing tells of one.

        A background without corners tells nothing: the camera is then taken to stand still.
        """
        scale = WIDTH / image.shape[1]
        size = (WIDTH, max(round(scale * image.shape[0]), 2 * PATCH))
        small = np.asarray(cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY))
        if self._key is None:
            self._begin(small, glass, scale)
            return np.zeros(2)
        if len(self._corners) < FEWEST:
            return np.zeros(2)
        # A glass that the border cuts still has one of its sides.
        sides = [
            (a - b, glass.bottom - self._home.bottom)
            for a, b in ((glass.left, self._home.left), (glass.right, self._home.right))
        ]
        guesses = [np.zeros(2), self._latest, *(scale * np.array(side, float) for side in sides)]
        found = [self._shift(small, guess, glass, scale) for guess in _distinct(guesses)]
        best, count = max(found, key=lambda one: one[1])
        self._latest = best if count > 0 else np.zeros(2)
        shift = self._latest / scale
        if count > 0 and np.abs(shift).max() < STEADY and np.abs(sides).max() > PATCH:
            self._begin(small, glass, scale)  # what the glass hid is seen now, and the other way round
        return shift if float(np.abs(shift).max()) > STEADY else np.zeros(2)

    def _begin(self, small: UInt8[np.ndarray, "h w"], glass: Box, scale: float) -> None:
        """Later pictures are compared with this one."""
        self._key, self._home, self._corners = small, glass, _corners(small, glass, scale)

    def _shift(
        self, small: UInt8[np.ndarray, "h w"], guess: Float[np.ndarray, "2"], glass: Box, scale: float
    ) -> tuple[Float[np.ndarray, "2"], int]:
        """Shift near a guess [px of the small picture], and how many corners agree; 0 where too few do."""
        assert self._key is not None
        start = (self._corners + guess).astype(np.float32)
        height, width = small.shape
        inside = ((start >= PATCH) & (start < [width - PATCH, height - PATCH])).all(axis=1) & ~_on(start, glass, scale)
        if inside.sum() < FEWEST:
            return np.zeros(2), 0
        ends, found, off = cv2.calcOpticalFlowPyrLK(
            self._key, small, self._corners[inside][:, None], start[inside][:, None].copy(), winSize=(PATCH, PATCH),
            maxLevel=1, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        moves = (ends[:, 0] - self._corners[inside]).astype(np.float64)
        fair = (found[:, 0] > 0) & (off[:, 0] < LIKE) & ~_on(ends[:, 0], glass, scale)
        if fair.sum() < FEWEST:
            return np.zeros(2), 0
        middle = np.median(moves[fair], axis=0)
        agreed = fair & (np.abs(moves - middle) < AGREED).all(axis=1)
        if agreed.sum() < max(FEWEST, SHARE * inside.sum()):
            return np.zeros(2), 0
        return moves[agreed].mean(axis=0), int(agreed.sum())


def _corners(small: UInt8[np.ndarray, "h w"], glass: Box, scale: float) -> Float[np.ndarray, "corners 2"]:
    """Corners of the background, px of the small picture."""
    mask = np.full(small.shape, 255, np.uint8)
    low, high = _around(glass, scale)
    mask[max(int(low[1]), 0) : int(high[1]) + 1, max(int(low[0]), 0) : int(high[0]) + 1] = 0
    found = cv2.goodFeaturesToTrack(small, CORNERS, QUALITY, APART, mask=mask)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)


def _around(glass: Box, scale: float) -> tuple[np.ndarray, np.ndarray]:
    more = AROUND * max(glass.right - glass.left, glass.bottom - glass.top)
    return (
        scale * np.array([glass.left - more, glass.top - more]),
        scale * np.array([glass.right + more, glass.bottom + more]),
    )


def _on(points: Float[np.ndarray, "corners 2"], glass: Box, scale: float) -> Bool[np.ndarray, " corners"]:
    """Which points [px of the small picture] are on the glass."""
    low, high = _around(glass, scale)
    return np.asarray(((points > low) & (points < high)).all(axis=1))


def _distinct(guesses: list[np.ndarray]) -> list[np.ndarray]:
    """Guesses that are more than a corner's patch apart: others lead to the same place."""
    kept: list[np.ndarray] = []
    for guess in guesses:
        if all(np.abs(guess - other).max() > 0.5 * PATCH for other in kept):
            kept.append(guess)
    return kept
