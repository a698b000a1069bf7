"""A segmentation that makes no mistake: the lab's own masks of a clip, to tell the share of vision in an error."""

from __future__ import annotations

import hashlib

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import DataError
from zsdt.lab.faults import FaultPlan
from zsdt.lab.glass_clips import GlassClip
from zsdt.perception.glass_segmentation import GlassMasks
from zsdt.perception.glass_window import Window
from zsdt.perception.video import FrameSource


class TrueMasks:
    """A `GlassSegmenter` for the pictures of one clip, which it knows by their content.

    source, plan: the clip with faults, and which: what a hand hides is no longer seen, a turned camera moves the masks,
    a repeated picture shows what it showed before. high: px by which the liquid ends too high.
    """

    def __init__(
        self, clip: GlassClip, source: FrameSource | None = None, plan: FaultPlan | None = None, high: int = 0
    ):
        self.clip, self.plan, self.high = clip, plan or FaultPlan(), high
        self._numbers: dict[bytes, int] = {}
        for frame in source or clip.source():
            self._numbers.setdefault(_digest(frame.image), frame.index)

    def masks(self, image: UInt8[np.ndarray, "height width 3"], window: Window | None = None) -> GlassMasks:
        """The true masks of a picture. Raises: DataError for a picture that is not of the clip."""
        number = self._numbers.get(_digest(image))
        if number is None:
            raise DataError(f"The picture is none of {self.clip.name}; true masks are known of its own pictures only.")
        container, liquid = (self._spoilt(mask, number) for mask in self.clip.masks(number))
        height, width = container.shape
        if self.high:
            liquid[: -self.high] = np.maximum(liquid[: -self.high], liquid[self.high :])
        return GlassMasks(container, np.minimum(liquid, container), window or Window.whole(height, width))

    def _spoilt(self, mask: UInt8[np.ndarray, "height width"], number: int) -> Float[np.ndarray, "height width"]:
        """Share of a class in each pixel as far as the faults of a frame leave it to be seen."""
        seen: np.ndarray = np.float32(1.0 / 255.0) * mask
        if number in self.plan.shift:
            moved = np.array([[1.0, 0.0, self.plan.shift[number]], [0.0, 1.0, 0.0]])
            seen = cv2.warpAffine(seen, moved, mask.shape[::-1])
        if number in self.plan.boxes:
            left, top, right, bottom = self.plan.boxes[number]
            seen[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = 0.0
        return np.asarray(seen, np.float32)


def _digest(image: UInt8[np.ndarray, "height width 3"]) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image).tobytes(), digest_size=16).digest()
