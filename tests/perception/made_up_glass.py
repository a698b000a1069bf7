"""Plain pictures of glasses with exact masks, and a segmentation that reads them off the colours."""

import numpy as np

from zsdt.perception.glass_segmentation import GlassMasks
from zsdt.perception.glass_vision_data import LabelledGlasses
from zsdt.perception.glass_window import OUTSIDE, Window, cut, put_back

GLASS, LIQUID, BACK = (210, 200, 190), (60, 110, 200), (70, 90, 60)


def drawn(h: int = 120, w: int = 160, middle: float = 80, level: int = 60, half: int = 25, top: int = 25):
    """Picture, container and liquid (bool) of an upright glass that stands 10 px above the lower border."""
    rows, columns = np.mgrid[:h, :w]
    container = (np.abs(columns - middle) <= half) & (rows >= top) & (rows < h - 10)
    liquid = container & (rows >= level)
    image = np.empty((h, w, 3), np.uint8)
    image[:] = BACK
    image[container] = GLASS
    image[liquid] = LIQUID
    return image, container, liquid


def labelled(count: int = 6, known: bool = True) -> LabelledGlasses:
    """Glasses of different places, widths and levels, with some noise."""
    rng = np.random.default_rng(0)
    shots = [
        drawn(
            middle=float(rng.uniform(50, 110)), level=int(rng.integers(40, 95)), half=int(rng.integers(18, 32)), top=30
        )
        for _ in range(count)
    ]
    images = [np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8) for image, _, _ in shots]
    masks = [[np.where(shot[k], 255, 0).astype(np.uint8) for shot in shots] for k in (1, 2)]
    return LabelledGlasses(images, *masks, [f"made up {k}" for k in range(count)], [known] * count)


class ByColour:
    """Reads container and liquid off the colours of `drawn`, at a working size, as a network would."""

    def __init__(self, size: int = 64):
        self.size, self.windows = size, []

    def masks(self, image, window=None):
        h, w = image.shape[:2]
        window = window or Window.whole(h, w)
        self.windows.append(window)
        part = cut(image, window, self.size).astype(np.float32)
        far, near = (((part - np.array(colour)) ** 2).sum(axis=2) for colour in (BACK, LIQUID))
        container = np.where((part == OUTSIDE).all(axis=2), 0, 1 - np.exp(-far / 4000)).astype(np.float32)
        liquid = np.exp(-near / 4000).astype(np.float32)
        return GlassMasks(put_back(container, window, h, w), put_back(liquid, window, h, w), window)
