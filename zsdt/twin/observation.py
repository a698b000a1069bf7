"""What was seen in one frame, and how a body would be seen: the operator between nodes and measurements.

A single camera measures two numbers of a point: where its ray meets the plane of the visible face. So a node that
leaves that plane is not misread as one that moved in it: the prediction goes through the same rays. With a measured
depth, or with motion capture, three numbers are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from zsdt.perception.camera import Camera
from zsdt.perception.depth import DepthOptions, look_up


@dataclass(frozen=True)
class Observation:
    """Tracked points of one frame.

    frame: number in the video. time [s]. pixels [points, 2]; seen [points]: those that were found. positions
    [points, 3] m in the axes of the body: on the plane of the face, or true ones where `has_depth`. blur: how many
    times noisier than usual the frame is.
    """

    frame: int
    time: float
    pixels: Float[np.ndarray, "points 2"]
    seen: Bool[np.ndarray, " points"]
    positions: Float[np.ndarray, "points 3"]
    has_depth: bool = False
    blur: float = 1.0


@runtime_checkable
class Measure(Protocol):
    """How positions of points are measured."""

    def values(self, positions: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points numbers"]:
        """What is measured [m] of points at `positions` [m]."""

    def slopes(self, positions: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points numbers 3"]:
        """Derivative of `values` by the positions."""

    def scatter(self, noise: float, depth_noise: float) -> Float[np.ndarray, " numbers"]:
        """Standard deviation [m] of each number, from that across the ray and that along it."""


@dataclass(frozen=True)
class RayMeasure:
    """A camera: where the ray of a point meets the plane at `depth` [m], along the picture's two axes; with
    `has_depth` the measured depth is the third number."""

    camera: Camera
    depth: float
    has_depth: bool = False

    def values(self, positions: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points numbers"]:
        """See `Measure`."""
        seen = positions @ self.camera.rotation.T + self.camera.translation
        flat = seen[:, :2] * (self.depth / seen[:, 2:])
        return np.concatenate([flat, seen[:, 2:]], axis=1) if self.has_depth else flat

    def slopes(self, positions: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points numbers 3"]:
        """See `Measure`."""
        rotation = self.camera.rotation
        seen = positions @ rotation.T + self.camera.translation
        share = self.depth / seen[:, 2]
        ray = seen[:, :2] / seen[:, 2:]
        flat = share[:, None, None] * (rotation[None, :2] - ray[:, :, None] * rotation[None, None, 2])
        if not self.has_depth:
            return flat
        return np.concatenate([flat, np.broadcast_to(rotation[2], (len(positions), 1, 3))], axis=1)

    def scatter(self, noise: float, depth_noise: float) -> Float[np.ndarray, " numbers"]:
        """See `Measure`."""
        return np.array([noise, noise, depth_noise]) if self.has_depth else np.array([noise, noise])


@dataclass(frozen=True)
class PointMeasure:
    """Motion capture: positions themselves, along the given `axes` (0 x, 1 y, 2 z)."""

    axes: tuple[int, ...] = (0, 1, 2)

    def values(self, positions: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points numbers"]:
        """See `Measure`."""
        return positions[:, list(self.axes)]

    def slopes(self, positions: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points numbers 3"]:
        """See `Measure`."""
        return np.broadcast_to(np.eye(3)[list(self.axes)], (len(positions), len(self.axes), 3))

    def scatter(self, noise: float, depth_noise: float) -> Float[np.ndarray, " numbers"]:
        """See `Measure`."""
        return np.full(len(self.axes), noise)


def observe(
    camera: Camera,
    depth: float,
    pixels: Float[np.ndarray, "points 2"],
    seen: Bool[np.ndarray, " points"],
    frame: int,
    time: float,
    depth_map: Float[np.ndarray, "height width"] | None = None,
    depth_options: DepthOptions | None = None,
    blur: float = 1.0,
) -> Observation:
    """The observation of tracked pixels by a camera in the axes of the body, `depth` [m] from the face.

    Pixels that are no numbers or lie outside of the picture are not seen. With a depth map the positions are true
    ones where the map has values; a point without a value there is not seen.
    """
    size = np.array([camera.width, camera.height])
    inside = np.isfinite(pixels).all(axis=1)
    inside[inside] = ((pixels[inside] >= -0.5) & (pixels[inside] <= size - 0.5)).all(axis=1)
    seen = seen & inside
    safe = np.where(inside[:, None], pixels, 0.5 * size)
    if depth_map is None:
        return Observation(frame, time, pixels, seen, camera.at_depth(safe, depth), blur=blur)
    found = look_up(depth_map, safe, np.nan, depth_options)
    known = np.isfinite(found.depth)
    positions = camera.at_depth(safe, np.where(known, found.depth, depth))
    return Observation(frame, time, pixels, seen & known, positions, has_depth=True, blur=blur)
