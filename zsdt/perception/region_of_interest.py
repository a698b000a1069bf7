"""Keeps the window of segmentation around one glass from frame to frame, and finds the glass again when it is lost."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from zsdt.errors import OptionError
from zsdt.perception.glass_segmentation import GlassInstance, GlassMasks, GlassSegmenter, instances
from zsdt.perception.glass_window import Box, Window


@dataclass
class RegionOptions:
    """margin: what a fresh window shows beside the container, share of its longer side. slack: the window moves when
    less than this share is left on a side. resize: change of the container's size, as a share, from which the window
    gets a new size. patience: frames without any glass after which parts of the picture are searched one by one
    (again after as many). smallest: share of the window below which a patch is no container.
    """

    margin: float = 0.25
    slack: float = 0.12
    resize: float = 0.15
    patience: int = 10
    smallest: float = 0.01

    def __post_init__(self) -> None:
        if not 0 <= self.slack < self.margin <= 2 or not 0 < self.resize < 1:
            raise OptionError("slack must be below margin, margin at most 2, and resize within 0 to 1.")
        if self.patience < 1 or not 0 < self.smallest < 1:
            raise OptionError("patience must be at least 1 and smallest within 0 to 1.")


class RegionOfInterest:
    """Follows one glass of a video: the largest of the first picture that shows one, then always that one.

    `window` is where it will look next (None: everywhere); after `masks`, `instance` is the glass that it found (None:
    none) and `others` how many more the window showed.
    """

    def __init__(self, segmenter: GlassSegmenter, options: RegionOptions | None = None):
        self._segmenter, self._options = segmenter, options or RegionOptions()
        self.window: Window | None = None
        self.instance: GlassInstance | None = None
        self.others = 0
        self._box: Box | None = None
        self._missed = 0

    def masks(self, image: UInt8[np.ndarray, "h w 3"]) -> GlassMasks:
        """Container and liquid of the followed glass alone; nothing where it is not to be seen."""
        self.instance, self.others = None, 0
        masks = self._follow(image) if self.window else None
        masks = masks or self._search(image)
        if masks is None:
            self.window = None
            self._missed += 1
            return GlassMasks.nothing(*image.shape[:2])
        self._missed = 0
        return masks

    def _follow(self, image: UInt8[np.ndarray, "h w 3"]) -> GlassMasks | None:
        """The glass near where it was; None where it is not."""
        assert self.window is not None
        masks = self._look(image, self.window)
        if masks is not None and self._leaves(image):
            assert self.instance is not None
            moved = Window.around(self.instance.box.middle, float(self.window.side))
            masks = self._look(image, moved) or masks
        if masks is not None:
            self._aim()
        return masks

    def _search(self, image: UInt8[np.ndarray, "h w 3"]) -> GlassMasks | None:
        """The glass anywhere: in the whole picture, now and then in its parts, then looked at from near by."""
        h, w = image.shape[:2]
        places = [Window.whole(h, w)]
        if self._missed % self._options.patience == 0:
            places += parts(h, w)
        for place in places:
            masks = self._look(image, place, anywhere=True)
            for _ in range(2):  # the second look, at a better size, corrects the first one's box
                if masks is not None:
                    self._aim(afresh=True)
                    assert self.window is not None
                    masks = self._look(image, self.window)
            if masks is not None:
                self._aim(afresh=True)
                return masks
        return None

    def _look(self, image: UInt8[np.ndarray, "h w 3"], window: Window, anywhere: bool = False) -> GlassMasks | None:
        """Segments a window and keeps the glass that overlaps the last one most (anywhere: the largest)."""
        masks = self._segmenter.masks(image, window)
        found = instances(masks, self._options.smallest)
        if found and self._box is not None and not anywhere:
            last = self._box
            found = [one for one in found if _overlap(one.box, last) > 0]
            found.sort(key=lambda one: -_overlap(one.box, last))
        if not found:
            return None
        self.instance, self.others = found[0], len(found) - 1
        self._box = self.instance.box
        return _alone(masks, self.instance)

    def _leaves(self, image: UInt8[np.ndarray, "h w 3"]) -> bool:
        """Whether the border of the window, and not that of the picture, cuts the glass."""
        assert self.instance is not None and self.window is not None
        box, window = self.instance.box, self.window
        h, w = image.shape[:2]
        return (
            max(window.left, 0) >= box.left > 0
            or max(window.top, 0) >= box.top > 0
            or min(window.left + window.side, w) <= box.right < w
            or min(window.top + window.side, h) <= box.bottom < h
        )

    def _aim(self, afresh: bool = False) -> None:
        """The window of the next picture: as it is, unless the glass has come near its border or changed its size."""
        assert self.instance is not None
        options, box = self._options, self.instance.box
        side = box.extent * (1 + 2 * options.margin)
        if self.window is not None and not afresh:
            same = abs(side / self.window.side - 1) < options.resize or self.instance.cut_off
            slack = options.slack * box.extent
            near = (
                box.left - self.window.left < slack
                or box.top - self.window.top < slack
                or self.window.left + self.window.side - box.right < slack
                or self.window.top + self.window.side - box.bottom < slack
            )
            if same and not near:
                return
            side = self.window.side if same else side
        self.window = Window.around(box.middle, float(side))


def parts(height: int, width: int) -> list[Window]:
    """Squares of half the longer side of a picture that cover it and overlap by half."""
    side = max(height, width) // 2
    if side < 2:
        return []

    def starts(length: int) -> list[int]:
        if length <= side:
            return [(length - side) // 2]
        count = -(-2 * (length - side) // side) + 1
        return [round(k * (length - side) / (count - 1)) for k in range(count)]

    return [Window(left, top, side) for top in starts(height) for left in starts(width)]


def _overlap(one: Box, other: Box) -> float:
    """Intersection over union of two boxes."""
    wide = min(one.right, other.right) - max(one.left, other.left)
    high = min(one.bottom, other.bottom) - max(one.top, other.top)
    if wide <= 0 or high <= 0:
        return 0.0
    areas = [(box.right - box.left) * (box.bottom - box.top) for box in (one, other)]
    return wide * high / (sum(areas) - wide * high)


def _alone(masks: GlassMasks, instance: GlassInstance) -> GlassMasks:
    """The masks without what else they show; the soft border of the glass stays."""
    rows, columns = masks.window.inside(*masks.container.shape)
    strange = ((masks.container[rows, columns] > 0.5) & ~instance.container[rows, columns]).view(np.uint8)
    if not strange.any():
        return masks
    away = (cv2.dilate(strange, np.ones((5, 5), np.uint8)) > 0) & ~instance.container[rows, columns]
    container, liquid = masks.container.copy(), masks.liquid.copy()
    container[rows, columns][away] = 0
    liquid[rows, columns][away] = 0
    return GlassMasks(container, liquid, masks.window)
