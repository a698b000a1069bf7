"""The part of a frame around the nodes as a small grey pyramid, and the flow of nodes between two such parts.

The flow is OpenCV's pyramidal Lucas-Kanade, forward and backward, in the image of half the size. (OpenCV's Python
door takes no prebuilt pyramids, so halves are what can be kept from frame to frame.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64

from zsdt.perception.frame_quality import light

COARSE = 2  # level of the pyramid in which lost nodes are looked for
BLOCK = 2**COARSE  # px to which regions are aligned, so that levels of different frames fit each other
SPARE = 0.1  # of the nodes' extent by which a region is made larger than it has to be
FLOW_STEPS, FLOW_SETTLED = 10, 0.03


@dataclass
class View:
    """The region of a frame: its upper left corner, grey image, half and quarter of it, and the nodes found in it."""

    origin: Float64[np.ndarray, "2"]
    image: Any
    half: Any
    quarter: Any
    pixels: Float64[np.ndarray, "nodes 2"]
    seen: Bool[np.ndarray, " nodes"]


class Region:
    """Cuts the region of the nodes out of frames. Its size only grows; its corner moves with the nodes."""

    def __init__(self, room: int, smooth: bool):
        self.room, self.smooth = room, smooth
        self._size = np.zeros(2, dtype=int)

    def cut(self, image: Any, nodes: Float[np.ndarray, "nodes 2"]) -> View:
        """The region with at least `room` px around the nodes, as far as the frame goes."""
        shape = np.array(image.shape[1::-1])
        low, high = nodes.min(axis=0), nodes.max(axis=0)
        if (high - low + self.room > self._size).any():
            wanted = high - low + 2 * self.room + SPARE * (high - low).max()
            self._size = np.maximum(self._size, np.minimum(BLOCK * np.ceil(wanted / BLOCK), shape).astype(int))
        corner = np.rint((0.5 * (low + high) - 0.5 * self._size) / BLOCK) * BLOCK
        corner = np.clip(corner, 0, (shape - self._size) // BLOCK * BLOCK).astype(int)
        image = grey(image[corner[1] : corner[1] + self._size[1], corner[0] : corner[0] + self._size[0]])
        half = cv2.pyrDown(image)
        nobody = np.zeros(len(nodes), bool)
        return View(corner.astype(np.float64), self.quiet(image), half, cv2.pyrDown(half), nodes, nobody)

    def quiet(self, image: Any) -> Any:
        """The image with less noise, where that is wanted."""
        return cv2.GaussianBlur(image, (3, 3), 0) if self.smooth else image


def grey(image: Any) -> Any:
    """Grey levels of a picture in colour (BGR) or grey."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def flow_between(
    last: View,
    view: View,
    guess: Float[np.ndarray, "nodes 2"],
    lit: tuple[float, float],
    window: int,
    levels: int,
    most_open: float,
) -> tuple[Float64[np.ndarray, "nodes 2"], Bool[np.ndarray, " nodes"]]:
    """Flow of the nodes seen in the last view less the guess [px], and whether it leads back to where it came from.

    lit: mean and deviation of grey levels to which both are brought. window, levels: of the pyramid of the half.
    most_open [px]: how far from its start the way back may end.
    """
    surprise, trusted = np.zeros_like(guess), np.zeros(len(guess), bool)
    ids = np.flatnonzero(last.seen)
    if levels == 0 or not len(ids):
        return surprise, trusted
    before, after = (_evened(part, view.half.shape, lit) for part in (last.half, view.half))
    old = ((last.pixels[ids] - last.origin) / 2).astype(np.float32)
    expected = ((guess[ids] - view.origin) / 2).astype(np.float32)
    choice: dict[str, Any] = {
        "winSize": (window, window),
        "maxLevel": levels - 1,
        "criteria": (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, FLOW_STEPS, FLOW_SETTLED),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    new, ahead, _ = cv2.calcOpticalFlowPyrLK(before, after, old, expected.copy(), **choice)
    # The way back begins as far off as the way there did, so that coming back is no matter of course.
    back, behind, _ = cv2.calcOpticalFlowPyrLK(after, before, new, old + (new - expected), **choice)
    closed = 2.0 * np.linalg.norm(back - old, axis=1) < most_open
    surprise[ids] = 2.0 * (new - expected)
    trusted[ids] = (ahead[:, 0] > 0) & (behind[:, 0] > 0) & closed
    return surprise, trusted


def _evened(half: Any, size: tuple[int, int], lit: tuple[float, float]) -> Any:
    """Image at a size (padded at right and bottom) and with given light."""
    mean, deviation = light(half)
    gain = lit[1] / max(deviation, 1e-3)
    even = cv2.addWeighted(half, gain, half, 0.0, lit[0] - gain * mean)
    down, right = size[0] - half.shape[0], size[1] - half.shape[1]
    return cv2.copyMakeBorder(even, 0, down, 0, right, cv2.BORDER_REPLICATE) if down or right else even
