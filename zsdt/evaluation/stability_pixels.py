"""A camera without pictures: the twin gets the true pixels of the visible nodes with noise, and the loop does the rest.

Painting and tracking cost a hundred times what prediction and correction cost, and are tried by the camera cases. Here
the first picture is a drawing of the grid's lines, from which the whole of the first frame is done as always.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from zsdt.errors import DataError
from zsdt.perception.camera import Camera, ClampSide
from zsdt.perception.video import VideoFrame
from zsdt.trajectory import Body
from zsdt.twin.beam_graph import front_nodes_of

SIZE = (960, 540)  # px
FILL = (0.7, 0.5)  # of the picture's width and height that a beam takes at most
FOCAL = 1100.0  # px
NOISE = 0.2  # px: standard deviation of a tracked node
LINE = 5  # px: width of a drawn line
SIDE = ClampSide.left


def camera_before(body: Body, focal: float = FOCAL) -> Camera:
    """A camera straight in front of a beam's side, as far away as fills the picture."""
    length, width, depth = (float(x) for x in np.ptp(body.points, axis=0))
    height = 0.5 * depth - 0.15 * length  # beams hang
    return Camera.facing(
        distance=focal * max(length / (FILL[0] * SIZE[0]), depth / (FILL[1] * SIZE[1])),
        look_at=(0.5 * length, height),
        focal=focal,
        beam_width=width,
        clamp_side=SIDE,
        size=SIZE,
    )


@dataclass
class SeenNodes:
    """True pixels [frames, columns, rows, 2] of the visible nodes of a beam before a camera."""

    camera: Camera
    depth: float
    pixels: Float[np.ndarray, "frames columns rows 2"]

    @classmethod
    def of(cls, body: Body, position: Float[np.ndarray, "frames nodes 3"]) -> SeenNodes:
        """How the visible side of a beam is seen while it moves through `position` [m]."""
        camera, front = camera_before(body), front_nodes_of(body, SIDE)
        depth = float(camera.depths(body.points[front.ravel()]).mean())
        flat = np.stack([camera.project(p[front.ravel()]) for p in position])
        return cls(camera, depth, flat.reshape(len(position), *front.shape, 2))


class GreySource:
    """Grey pictures that hold nothing but their number."""

    name = "exact pixels"

    def __init__(self, frames: int, fps: float):
        self.count, self.fps, self.size = frames, fps, SIZE
        self.missing: list[int] = []

    def __iter__(self) -> Iterator[VideoFrame]:
        for index in range(self.count):
            image = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
            image[0, 0] = (index % 256, index // 256 % 256, 0)
            yield VideoFrame(index, index / self.fps, image)


class DrawnGrid:
    """A segmentation that knows the lines of the first picture."""

    def __init__(self, seen: SeenNodes):
        self.pixels = seen.pixels[0]

    def probability(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """Cover of the grid's lines, 0 to 1."""
        canvas = np.zeros(image.shape[:2], np.uint8)
        lines = [*self.pixels, *self.pixels.swapaxes(0, 1)]
        cv2.polylines(canvas, [np.rint(16 * p).astype(np.int32) for p in lines], False, 255, LINE, cv2.LINE_AA, 4)
        return canvas.astype(np.float32) / 255


@dataclass
class Tracked:
    """What a tracker says of a frame (see `zsdt.twin.loop.Tracks`)."""

    pixels: Float[np.ndarray, "points 2"]
    seen: Bool[np.ndarray, " points"]
    quality: str = "good"


class NodeTracker:
    """A tracker that follows the nodes of the first frame with NOISE px and never loses one."""

    def __init__(self, seen: SeenNodes, seed: int = 0):
        self.pixels = seen.pixels.reshape(len(seen.pixels), -1, 2)
        self.rng = np.random.default_rng([seed, 0x57AB])
        self.frame = 0

    def start(
        self, image: UInt8[np.ndarray, "h w 3"], pixels: Float[np.ndarray, "points 2"], edges: Int[np.ndarray, "e 2"]
    ) -> None:
        """Follows the points where they were found in the first picture. Raises: DataError where it is another grid."""
        if pixels.shape != self.pixels[0].shape:
            raise DataError(f"The grid found has {len(pixels)} nodes, the beam shows {len(self.pixels[0])}.")
        self.offset = pixels - self.pixels[0]

    def track(
        self, image: UInt8[np.ndarray, "h w 3"] | None, predicted: Float[np.ndarray, "points 2"] | None = None
    ) -> Tracked:
        """The points in the next picture."""
        self.frame += 1
        noise = NOISE * self.rng.standard_normal(self.offset.shape)
        return Tracked(self.pixels[self.frame] + self.offset + noise, np.ones(len(noise), bool))
