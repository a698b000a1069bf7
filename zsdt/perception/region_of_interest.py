"""Keeps the window of segmentation around one glass from frame to frame, and finds the glass again when it is lost."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import UInt8

from zsdt.errors import OptionError
from zsdt.perception.glass_memory import GlassMemory, MemoryOptions
from zsdt.perception.glass_segmentation import (
    GlassInstance,
    GlassMasks,
    GlassSegmenter,
    MirroringSegmenter,
    alone,
    instances,
    mean_of,
)
from zsdt.perception.glass_window import Box, Window, box_of


@dataclass
class RegionOptions:
    """margin: what a window shows beside the container, share of its longer side, in the first `wide` pictures in which
    it is followed: vision may not see all of a glass at once. near: the same from then on: a closer window shows finer
    edges. slack: the window moves when less than this share will be left on a side. resize: change of the container's
    size, as a share, from which the window gets a new size. patience: frames without any glass after which parts of the
    picture are searched one by one (again after as many). smallest: share of the window below which a patch is no
    container. memory: of what earlier pictures showed of the glass.
    """

    margin: float = 0.25
    wide: int = 8
    near: float = 0.08
    slack: float = 0.03
    resize: float = 0.05
    patience: int = 10
    smallest: float = 0.01
    memory: MemoryOptions = field(default_factory=MemoryOptions)

    def __post_init__(self) -> None:
        if not 0 <= self.slack < self.near <= self.margin <= 2 or not 0 < self.resize < 0.3:
            raise OptionError(
                "slack must be below near, near at most margin, margin at most 2, resize within 0 to 0.3."
            )
        if self.wide < 0:
            raise OptionError("wide counts pictures; it cannot be negative.")
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
        self._followed = 0
        self._middle: tuple[float, float] | None = None
        self._memory = GlassMemory(self._options.memory)

    def masks(self, image: UInt8[np.ndarray, "h w 3"]) -> GlassMasks:
        """Container and liquid of the followed glass alone, steadied by what earlier pictures showed of it; nothing
        where it is not to be seen."""
        self.instance, self.others = None, 0
        masks = self._follow(image) if self.window else None
        if masks is None:
            self._forget()
            masks = self._search(image)
        if masks is None:
            self.window = None
            self._missed += 1
            return GlassMasks.nothing(*image.shape[:2])
        self._missed = 0
        assert self.instance is not None
        masks = self._memory.steadied(masks, self.instance.box)
        self._keep_near(masks)
        return masks

    def _forget(self) -> None:
        """What was known of the glass that was followed."""
        self._memory.forget()
        self._followed, self._middle = 0, None

    def _follow(self, image: UInt8[np.ndarray, "h w 3"]) -> GlassMasks | None:
        """The glass near where it was; None where it is not. Every other picture is looked at in the mirror: memory
        then holds both views, whose errors differ."""
        assert self.window is not None
        mirrored = self._options.memory.frames > 1 and self._followed % 2 == 1
        masks = self._look(image, self.window, mirrored=mirrored)
        if masks is not None and self._leaves(image):
            assert self.instance is not None
            moved = Window.around(self.instance.box.middle, float(self.window.side))
            masks = self._look(image, moved, mirrored=mirrored) or masks
        return masks

    def _search(self, image: UInt8[np.ndarray, "h w 3"]) -> GlassMasks | None:
        """The glass anywhere: in the whole picture, now and then in its parts, then looked at from near by."""
        h, w = image.shape[:2]
        places = [Window.whole(h, w)]
        if self._missed % self._options.patience == 0:
            places += parts(h, w)
        for place in places:
            if self._look(image, place, anywhere=True) is None:
                continue
            # The second look, at a better size, corrects the first one's box, and the last one the second's masks.
            rough = self._look(image, self._aimed())
            fine = None if rough is None else self._look(image, self._aimed(), mirrored=True)
            if rough is not None and fine is not None:
                self.window = self._aimed()
                return self._from_near(image, mean_of(rough, fine))
        return None

    def _from_near(self, image: UInt8[np.ndarray, "h w 3"], masks: GlassMasks) -> GlassMasks:
        """The masks with two looks from nearer at what was found of the glass, as there is no memory yet; what these
        cut off stays."""
        found, box, others = self.instance, self._box, self.others
        assert box is not None
        window = Window.around(box.middle, box.extent * (1 + 2 * self._options.near))
        near = [self._look(image, window, mirrored=mirrored) for mirrored in (False, True)]
        self.instance, self._box, self.others = found, box, others
        return masks if near[0] is None or near[1] is None else mean_of(mean_of(near[0], near[1]), masks)

    def _look(
        self, image: UInt8[np.ndarray, "h w 3"], window: Window, anywhere: bool = False, mirrored: bool = False
    ) -> GlassMasks | None:
        """Segments a window, or its mirror image where the segmentation can, and keeps the glass that overlaps the last
        one most (anywhere: the largest)."""
        if mirrored and isinstance(self._segmenter, MirroringSegmenter):
            masks = self._segmenter.mirrored(image, window)
        else:
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
        return alone(masks, self.instance)

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

    def _aimed(self) -> Window:
        """The window for another look at the same picture."""
        assert self.instance is not None
        box = self.instance.box
        return Window.around(box.middle, box.extent * (1 + 2 * self._options.margin))

    def _keep_near(self, masks: GlassMasks) -> None:
        """The window of the next picture: as it is, unless the glass will come near its border, has changed its size or
        is now known well enough to look from nearer. A glass is thought to go on as it went."""
        assert self.instance is not None and self.window is not None
        options, window = self._options, self.window
        rows, columns = window.inside(*masks.container.shape)
        found = box_of(masks.container[rows, columns] > 0.5)
        box = self.instance.box if found is None else found.moved(columns.start, rows.start)
        before, self._middle = self._middle or box.middle, box.middle
        ahead = box.moved(*(round(now - then) for now, then in zip(box.middle, before, strict=True)))
        self._followed += 1
        known = self._followed > options.wide
        side = box.extent * (1 + 2 * (options.near if known else options.margin))
        same = abs(side / window.side - 1) < options.resize or self.instance.cut_off
        if self._followed == options.wide + 1:
            same = False
        slack = options.slack * box.extent
        near = (
            ahead.left - window.left < slack
            or ahead.top - window.top < slack
            or window.left + window.side - ahead.right < slack
            or window.top + window.side - ahead.bottom < slack
        )
        if near or not same:
            self.window = Window.around(ahead.middle, float(window.side if same else side))


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
