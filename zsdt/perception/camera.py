"""A pinhole camera with lens distortion: from points in the room to pixels and, where the depth is known, back.

Pixels are (u right, v down) with pixel centres at integers; the frame of the camera is x right, y down, z forward
(OpenCV). Distances in m, focal lengths in pixels.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError, OptionError
from zsdt.files import atomic_path

SCHEMA = "zsdt.camera"
SCHEMA_VERSION = 1
# Undistortion has no closed form: OpenCV's fixed point is iterated until it is good to far below a pixel.
UNDISTORT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)


class ClampSide(StrEnum):
    """The side of the picture on which the beam is clamped."""

    left = "left"
    right = "right"

    @property
    def front_layer(self) -> str:
        """Which layer of the body the camera sees: ``low_y`` (y = 0) or ``high_y`` (y = width)."""
        return "low_y" if self is ClampSide.left else "high_y"

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the world of a beam to a camera that looks straight at its front face.

        Rows are the camera's axes: z of the world is up in the picture and both frames are right-handed, so a
        clamp at the right shows the other face of the beam.
        """
        x, y, z = np.eye(3)
        return np.stack([x, -z, y]) if self is ClampSide.left else np.stack([-x, -z, -y])


@dataclass(frozen=True)
class Camera:
    """Pinhole with distortion; ``X_camera = rotation @ X_world + translation``.

    matrix [3, 3] px, distortion [5] in OpenCV's order k1 k2 p1 p2 k3, rotation [3, 3], translation [3] m, size of
    the picture `width` x `height` px. Raises: OptionError where the parts do not make a camera.
    """

    matrix: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"]
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    width: int
    height: int

    def __post_init__(self) -> None:
        shapes = {"matrix": (3, 3), "distortion": (5,), "rotation": (3, 3), "translation": (3,)}
        for name, shape in shapes.items():
            values = np.asarray(getattr(self, name), np.float64)
            if values.shape != shape or not np.isfinite(values).all():
                raise OptionError(f"The camera's {name} must be {shape} finite numbers, not {values.tolist()}.")
            object.__setattr__(self, name, values)
        if self.matrix[0, 0] <= 0 or self.matrix[1, 1] <= 0 or self.width < 1 or self.height < 1:
            raise OptionError("Focal lengths and picture size of a camera must be positive.")
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(self.rotation) < 0:
            raise OptionError("The camera's rotation is no rotation (it must be orthonormal and right-handed).")

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Where the camera is in the world [m]."""
        return -self.rotation.T @ self.translation

    def depths(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Depth of world points [m] along the optical axis."""
        return points @ self.rotation[2] + self.translation[2]

    def project(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 2"]:
        """Pixels of world points [m]; NaN for points that are not in front of the camera."""
        if not len(points):
            return np.zeros((0, 2))
        seen = points @ self.rotation.T + self.translation
        front = seen[:, 2] > 1e-9
        if not front.all():
            seen = np.where(front[:, None], seen, [0.0, 0.0, 1.0])
        pixels, _ = cv2.projectPoints(seen[:, None], np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return np.where(front[:, None], pixels[:, 0], np.nan)

    def normalise(self, pixels: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Pixels without distortion at depth 1: ``K^-1 [u v 1]`` of an ideal lens."""
        if not len(pixels):
            return np.zeros((0, 2))
        given = np.ascontiguousarray(pixels, np.float64)[:, None]
        return cv2.undistortPoints(given, self.matrix, self.distortion, criteria=UNDISTORT)[:, 0]

    def at_depth(
        self, pixels: Float[np.ndarray, "points 2"], depth: float | Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points 3"]:
        """World points [m] of pixels at a known `depth` [m] along the optical axis (seed, monocular projection).

        ``X = d K^-1 [u v 1]'`` after undistortion. The depth is a constant or one value for each pixel (see
        `zsdt.perception.depth`).
        """
        rays = np.column_stack([self.normalise(pixels), np.ones(len(pixels))])
        return (rays * np.asarray(depth, np.float64).reshape(-1, 1) - self.translation) @ self.rotation

    def on_plane(
        self, pixels: Float[np.ndarray, "points 2"], point: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "points 3"]:
        """World points [m] where the rays of pixels meet the plane through `point` [m] with `normal`.

        NaN where a ray does not meet it in front of the camera.
        """
        rays = np.column_stack([self.normalise(pixels), np.ones(len(pixels))]) @ self.rotation
        slope = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            far = ((point - self.center) @ normal) / slope
        far = np.where(np.isfinite(far) & (far > 0), far, np.nan)
        return self.center + rays * far[:, None]

    @classmethod
    def facing(
        cls,
        *,
        distance: float,
        look_at: tuple[float, float],
        focal: float,
        beam_width: float,
        clamp_side: ClampSide | str = ClampSide.left,
        size: tuple[int, int] = (960, 540),
        distortion: Float[np.ndarray, "5"] | None = None,
    ) -> Camera:
        """The nominal camera: straight in front of a beam's visible face, `distance` [m] away from it.

        look_at: (x, z) [m] of the beam in the centre of the picture; focal [px]; beam_width [m] along y; clamp at
        the left shows the face y = 0, at the right the face y = beam_width; size: (width, height) px.
        """
        side = ClampSide(clamp_side)
        back = -distance if side is ClampSide.left else beam_width + distance
        width, height = size
        axes = side.axes
        return cls(
            matrix=np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]]),
            distortion=np.zeros(5) if distortion is None else distortion,
            rotation=axes,
            translation=-axes @ np.array([look_at[0], back, look_at[1]]),
            width=width,
            height=height,
        )

    def describe(self) -> dict[str, Any]:
        """The camera as plain values (px, m)."""
        arrays = {name: getattr(self, name).tolist() for name in ("matrix", "distortion", "rotation", "translation")}
        return {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            **arrays,
            "width": self.width,
            "height": self.height,
        }


def save_camera(path: str | os.PathLike[str], camera: Camera) -> None:
    """Writes a camera as JSON. Raises: DataError where the disk does not take it."""
    with atomic_path(path) as beside:
        beside.write_text(json.dumps(camera.describe(), indent=1))


def load_camera(path: str | os.PathLike[str]) -> Camera:
    """Reads what `save_camera` wrote.

    rotation and translation may be left out of a file that somebody writes by hand: world and camera then agree.
    Raises: DataError where the file is missing, is no JSON or is no camera.
    """
    if not Path(path).is_file():
        raise DataError(f"There is no camera file {path}; run the stage calibrate_camera or correct the path.")
    try:
        card = json.loads(Path(path).read_text())
        if card.get("schema", SCHEMA) != SCHEMA or card.get("schema_version", SCHEMA_VERSION) != SCHEMA_VERSION:
            raise DataError(
                f"{path} is no camera of this program ({SCHEMA} version {SCHEMA_VERSION}); calibrate again."
            )
        return Camera(
            matrix=np.array(card["matrix"], np.float64),
            distortion=np.array(card["distortion"], np.float64),
            rotation=np.array(card.get("rotation", np.eye(3).tolist()), np.float64),
            translation=np.array(card.get("translation", [0.0, 0.0, 0.0]), np.float64),
            width=int(card["width"]),
            height=int(card["height"]),
        )
    except (ValueError, KeyError, TypeError, AttributeError, OptionError) as error:
        raise DataError(
            f"{path} does not hold a camera ({error}); it needs matrix, distortion, width, height."
        ) from error
