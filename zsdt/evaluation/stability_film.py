"""A film of a glass without pictures: exact masks of the vessel and of a surface that is level into the depth.

Everything between masks and particles is the twin's own: geometry of the glass, its motion, t0, the surface. Ray
tracing and segmentation, which cost far more, are tried by the twin's own evaluation.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from zsdt.evaluation.glass_scenes import GlassScene, masks, side_camera
from zsdt.perception.camera import Camera
from zsdt.perception.glass_segmentation import GlassMasks
from zsdt.perception.glass_window import Window
from zsdt.perception.video import VideoFrame
from zsdt.scene import VesselShape
from zsdt.twin.glass_levels import reader_of

SIZE = (400, 250)  # px
TERMS = 5  # of the polynomial in x that the surface is drawn as
GRAIN = 5e-5  # m: surfaces that differ by less are drawn once


def camera_before(shape: VesselShape) -> Camera:
    """A camera that shows all of a vessel and looks down steeply enough to see the far wall behind a wave."""
    size = max(shape.rim, 2.0 * max(shape.radii))
    return side_camera(distance=5.0 * size, height=2.3 * size, look_down=0.36, focal=700.0, size=SIZE)


def surface_of(
    shape: VesselShape, spacing: float, volume: float, position: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " terms"]:
    """The free surface of particles over the line y = 0 as a polynomial in x [m]."""
    reader = reader_of(shape, spacing)
    places = np.stack([np.linspace(-0.9, 0.9, 20) * max(shape.radii), np.zeros(20)], axis=1)
    height = reader.at(reader.holding(reader.through(*reader.read(position)), volume), places)
    return np.polynomial.polynomial.polyfit(places[:, 0], np.clip(height, 0.0, shape.rim), TERMS - 1)


class Film:
    """Frames of a vessel at places x [frames] m with a surface each [frames, terms]; a source and a segmentation."""

    name = "exact masks"

    def __init__(
        self,
        shape: VesselShape,
        x: Float[np.ndarray, " frames"],
        surfaces: Float[np.ndarray, "frames terms"],
        fps: float,
    ):
        self.shape, self.x, self.surfaces, self.fps, self.size = shape, x, surfaces, fps, SIZE
        self.count: int | None = len(x)
        self.missing: list[int] = []
        self._drawn: dict[bytes, tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]] = {}

    @cached_property
    def camera(self) -> Camera:
        """The camera before the vessel."""
        return camera_before(self.shape)

    def __iter__(self) -> Iterator[VideoFrame]:
        rng = np.random.default_rng(0)
        for frame in range(len(self.x)):
            image = rng.integers(60, 200, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
            image[0, 0] = (frame % 256, frame // 256 % 256, 0)
            yield VideoFrame(frame, frame / self.fps, image)

    def masks(self, image: UInt8[np.ndarray, "h w 3"], window: Window | None = None) -> GlassMasks:
        """Cover of container and liquid in a frame (see `GlassSegmenter`)."""
        frame = int(image[0, 0, 0]) + 256 * int(image[0, 0, 1])
        container, liquid = self._draw(frame)
        height, width = container.shape
        window = window or Window.whole(height, width)
        rows, columns = window.inside(height, width)
        found = []
        for part in (container, np.minimum(liquid, container)):
            whole = np.zeros((height, width), np.float32)
            whole[rows, columns] = part[rows, columns] / 255.0
            found.append(whole)
        return GlassMasks(found[0], found[1], window)

    def _draw(self, frame: int) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
        """Masks of a frame; of a still liquid they are drawn once."""
        grid = np.linspace(-1.0, 1.0, 9) * max(self.shape.radii)
        heights = np.polynomial.polynomial.polyval(grid, self.surfaces[frame])
        key = np.rint(np.append(heights, self.x[frame]) / GRAIN).astype(np.int64).tobytes()
        if key not in self._drawn:
            if len(self._drawn) > 64:
                self._drawn.clear()
            scene = GlassScene(self.shape, self.surfaces[frame], self.camera, x=float(self.x[frame]))
            self._drawn[key] = masks(scene)
        return self._drawn[key]
