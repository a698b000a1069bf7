"""Where container and liquid are in a picture, as probabilities for every pixel (seed: graph construction for fluids).

One interface, several ways to compute it: the U-Net by torch (eager) or OpenVINO, and YOLO11-seg as the seed has it
(`zsdt.perception.yolo_glass`, an optional package). Pixels are spent on the glass: a window of the picture is looked
at, at a fixed working size; `zsdt.perception.glass_tracking` keeps that window around the glass.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsdt.errors import DataError, OptionError
from zsdt.perception.glass_window import Box, Window, cut, put_back
from zsdt.perception.segmentation import PictureNetwork, SegmentationBackend, computed_by, folded, normalised
from zsdt.perception.unet_weights import CARD, load_unet

OUTPUTS = 2  # container (liquid included) and liquid
SIZE = 256  # px: working size of a window
YOLO_CARD = "yolo.json"


@dataclass(frozen=True)
class GlassMasks:
    """Probabilities [h, w] of container (liquid included) and liquid in a picture, zero outside the window."""

    container: Float[np.ndarray, "h w"]
    liquid: Float[np.ndarray, "h w"]
    window: Window

    @classmethod
    def nothing(cls, height: int, width: int) -> GlassMasks:
        """Neither container nor liquid."""
        return cls(
            np.zeros((height, width), np.float32), np.zeros((height, width), np.float32), Window.whole(height, width)
        )

    @property
    def empty(self) -> bool:
        """Whether no pixel shows a container."""
        rows, columns = self.window.inside(*self.container.shape)
        return not (self.container[rows, columns] > 0.5).any()


@dataclass(frozen=True)
class GlassInstance:
    """One container of a picture: container and liquid [h, w], its box, areas in px, and whether the border of the
    picture cuts it."""

    container: Bool[np.ndarray, "h w"]
    liquid: Bool[np.ndarray, "h w"]
    box: Box
    area: int
    liquid_area: int
    cut_off: bool


@runtime_checkable
class GlassSegmenter(Protocol):
    """Says where container and liquid are."""

    def masks(self, image: UInt8[np.ndarray, "h w 3"], window: Window | None = None) -> GlassMasks:
        """Probabilities in a picture (BGR), computed in the window (default: in all of it)."""


@runtime_checkable
class MirroringSegmenter(GlassSegmenter, Protocol):
    """Can look at the mirror image of a window as well: what it errs in there is another thing, at the same cost."""

    def mirrored(self, image: UInt8[np.ndarray, "h w 3"], window: Window | None = None) -> GlassMasks:
        """As `masks`; the answer is of the picture, not of its mirror image."""


def load_glass_segmenter(
    folder: str | Path, backend: SegmentationBackend = SegmentationBackend.eager, size: int | None = None
) -> GlassSegmenter:
    """The segmentation of glasses in `folder`, computed by `backend` at windows of `size` px.

    The folder holds a U-Net (`unet.json`) or a YOLO (`yolo.json`), which has its own backend. size: default is what
    the card says that it was trained at. Raises: DataError where the weights are missing or broken, OptionError where
    the backend is not installed or the size does not suit the network.
    """
    if (Path(folder) / YOLO_CARD).is_file():
        from zsdt.perception.yolo_glass import YoloGlassSegmenter  # an optional package

        return YoloGlassSegmenter(folder, size)
    network = folded(load_unet(folder, OUTPUTS))
    asked = size or trained_size(folder)
    return UNetGlassSegmenter(computed_by(network, backend), network.multiple, asked)


def trained_size(folder: str | Path) -> int:
    """Working size [px] of the windows that a U-Net was trained with."""
    try:
        return int(json.loads((Path(folder) / CARD).read_text()).get("size", SIZE))
    except (OSError, ValueError, AttributeError) as error:
        raise DataError(f"The card {CARD} in {folder} is broken ({error}); train the segmentation again.") from error


class UNetGlassSegmenter:
    """See `GlassSegmenter`. network: picture [1, size, size, 3] -> probabilities [1, 2, size, size]."""

    def __init__(self, network: PictureNetwork, multiple: int, size: int = SIZE):
        if size < multiple or size % multiple:
            raise OptionError(f"The working size must be a multiple of {multiple} px, not {size}.")
        self._network, self.size = network, size

    def masks(self, image: UInt8[np.ndarray, "h w 3"], window: Window | None = None) -> GlassMasks:
        """See `GlassSegmenter`."""
        return self._seen(image, window, mirrored=False)

    def mirrored(self, image: UInt8[np.ndarray, "h w 3"], window: Window | None = None) -> GlassMasks:
        """See `MirroringSegmenter`."""
        return self._seen(image, window, mirrored=True)

    def _seen(self, image: UInt8[np.ndarray, "h w 3"], window: Window | None, mirrored: bool) -> GlassMasks:
        h, w = image.shape[:2]
        window = window or Window.whole(h, w)
        part = cut(image, window, self.size)
        if mirrored:
            part = np.ascontiguousarray(part[:, ::-1])
        both = self._network(normalised(part)[None])[0]
        if mirrored:
            both = np.ascontiguousarray(both[..., ::-1])
        container, liquid = both
        # Liquid is where both are: the two probabilities are learned apart, and no liquid lies outside its container.
        return GlassMasks(
            put_back(container, window, h, w), put_back(np.minimum(liquid, container), window, h, w), window
        )


def instances(masks: GlassMasks, smallest: float = 0.01) -> list[GlassInstance]:
    """Containers that hang together, each with its liquid, largest first.

    smallest: share of the window below which a patch is no container.
    """
    h, w = masks.container.shape
    rows, columns = masks.window.inside(h, w)
    container = np.ascontiguousarray(masks.container[rows, columns] > 0.5)
    if not container.any():
        return []
    count, labels, stats, _ = cv2.connectedComponentsWithStats(container.view(np.uint8), connectivity=4)
    liquid = masks.liquid[rows, columns] > 0.5
    found = []
    for number in range(1, count):
        left, top, width, height, area = (int(value) for value in stats[number])
        if area < smallest * masks.window.side**2:
            continue
        box = Box(columns.start + left, rows.start + top, columns.start + left + width, rows.start + top + height)
        mine, wet = np.zeros((h, w), bool), np.zeros((h, w), bool)
        mine[rows, columns] = labels == number
        wet[rows, columns] = liquid & mine[rows, columns]
        cut_off = box.left <= 0 or box.top <= 0 or box.right >= w or box.bottom >= h
        found.append(GlassInstance(mine, wet, box, area, int(wet.sum()), cut_off))
    return sorted(found, key=lambda instance: -instance.area)


def alone(masks: GlassMasks, instance: GlassInstance) -> GlassMasks:
    """The masks without what else than one glass they show; the soft border of the glass stays."""
    rows, columns = masks.window.inside(*masks.container.shape)
    strange = ((masks.container[rows, columns] > 0.5) & ~instance.container[rows, columns]).view(np.uint8)
    if not strange.any():
        return masks
    away = (cv2.dilate(strange, np.ones((5, 5), np.uint8)) > 0) & ~instance.container[rows, columns]
    container, liquid = masks.container.copy(), masks.liquid.copy()
    container[rows, columns][away] = 0
    liquid[rows, columns][away] = 0
    return GlassMasks(container, liquid, masks.window)


def mean_of(one: GlassMasks, other: GlassMasks) -> GlassMasks:
    """The mean of two looks at one picture where both windows show it, else the other one; with its window."""
    h, w = one.container.shape
    parts = [masks.window.inside(h, w) for masks in (one, other)]
    place = tuple(slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(*parts, strict=True))
    container, liquid = other.container.copy(), other.liquid.copy()
    container[place] = 0.5 * (container[place] + one.container[place])
    liquid[place] = 0.5 * (liquid[place] + one.liquid[place])
    return GlassMasks(container, liquid, other.window)
