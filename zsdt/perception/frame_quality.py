"""Is there anything to be seen in a frame? Cheap judgements before and after its nodes are looked for."""

from __future__ import annotations

from collections import deque
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

LEAST_LIGHT = 0.12  # mean and contrast relative to the first frame's, below which a frame is dark
MOST_LIGHT = 247.0  # mean grey level from which a frame is overexposed
REPEATED = 0.05  # change between frames relative to the usual one, below which a frame is a repetition
REPEATS = 10  # repeated frames in a row, after which it is the scene that stands still
EXPECTED_MOTION = 0.5  # px per frame, below which a repetition that is not exact does no harm
NOISY = 0.5  # grey levels: usual change from which a sensor's noise is in it, so that no two frames are the same
EXACT_REPEATS = 60  # of a noisy video in a row, after which it is a still scene that somebody compressed
LEAST_SHARPNESS = 0.6  # relative to the first frame's
THINNING = 8  # every so many pixels are compared between frames


class FrameQuality(StrEnum):
    """What is wrong with a frame; `good` where nothing is."""

    good = "good"
    missing = "missing"
    dark = "dark"
    bright = "bright"
    frozen = "frozen"
    blurred = "blurred"


class QualityJudge:
    """Compares frames with the first one and with the one before."""

    def __init__(self, image: UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"], region: UInt8[np.ndarray, "a b"]):
        self._shape = image.shape
        self._mean, self._deviation = light(region)
        self._sharpness = sharpness(region)
        self._thumbnail = _thumbnail(image)
        self._latest = (self._thumbnail, 0.0)
        self._changes: deque[float] = deque(maxlen=15)
        self._repeats = 0

    def before(self, image: Any, motion: float) -> FrameQuality:
        """Judgement of a frame as it comes; `motion` [px] is what the nodes should have moved since the last one."""
        if image is None or not isinstance(image, np.ndarray) or image.shape != self._shape:
            return FrameQuality.missing
        thumbnail = _thumbnail(image)
        change = float(cv2.absdiff(thumbnail, self._thumbnail).mean())
        usual = sorted(self._changes)[len(self._changes) // 2] if self._changes else 0.0
        self._latest = (thumbnail, change)
        repeated = change <= REPEATED * usual
        self._repeats = self._repeats + 1 if repeated else 0
        if repeated and motion > EXPECTED_MOTION and self._repeats <= REPEATS:
            return FrameQuality.frozen
        # Who believes a frozen picture stands still, expects no motion, and would go on believing it.
        if change == 0.0 and usual > NOISY and self._repeats <= EXACT_REPEATS:
            return FrameQuality.frozen
        return FrameQuality.good

    def accept(self) -> None:
        """The latest frame was good: later ones are compared with it."""
        self._thumbnail, change = self._latest
        self._changes.append(change)

    def lit(self, region: UInt8[np.ndarray, "a b"]) -> FrameQuality:
        """Judgement by the light in the region of the nodes."""
        mean, deviation = light(region)
        if mean < LEAST_LIGHT * self._mean or (deviation < LEAST_LIGHT * self._deviation and mean < self._mean):
            return FrameQuality.dark
        if mean > MOST_LIGHT or deviation < LEAST_LIGHT * self._deviation:
            return FrameQuality.bright
        return FrameQuality.good

    def sharp(self, region: UInt8[np.ndarray, "a b"]) -> FrameQuality:
        """Judgement of a region in which hardly a node was found."""
        return FrameQuality.blurred if sharpness(region) < LEAST_SHARPNESS * self._sharpness else FrameQuality.good


def light(region: UInt8[np.ndarray, "a b"]) -> tuple[float, float]:
    """Mean and standard deviation [grey levels]."""
    mean, deviation = cv2.meanStdDev(region)
    return float(mean[0, 0]), float(deviation[0, 0])


def sharpness(region: UInt8[np.ndarray, "a b"]) -> float:
    """Mean second difference over the standard deviation: it does not change with gain or offset."""
    return float(np.abs(cv2.Laplacian(region, cv2.CV_16S)).mean()) / max(light(region)[1], 1e-6)


def _thumbnail(image: Any) -> Any:
    """A lattice of single pixels, in which noise is not averaged away: a repeated frame repeats it, too."""
    return np.ascontiguousarray(image[::THINNING, ::THINNING])
