"""Lines of sight at the two edges of a glass, row by row, and where they bisect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsdt.perception.camera import Camera
from zsdt.perception.mask_edges import MaskEdges

STRAY = 3.0  # px that an edge may lie off those of the rows beside it


@dataclass(frozen=True)
class Sight:
    """Lines of sight of one picture, in the room.

    eye [3] m: the camera. rows [rows] px; left, right [rows, 3]: unit directions at the edges. top, bottom
    [columns, 3]: those at the upper and lower edge of the columns between the outermost edges.
    """

    eye: Float[np.ndarray, "3"]
    rows: Float[np.ndarray, " rows"]
    left: Float[np.ndarray, "rows 3"]
    right: Float[np.ndarray, "rows 3"]
    top: Float[np.ndarray, "columns 3"]
    bottom: Float[np.ndarray, "columns 3"]

    def bisectors(self) -> Float[np.ndarray, " rows"]:
        """Angle from the plane x = 0 [rad] of the bisector of both edges, from above downwards or the other way.

        Edges are paired where their lines of sight climb alike: those are mirror images in the vertical plane through
        camera and axis, which rows of a rolled camera, or of one that stands aside, are not.
        """
        (left_climb, left), (right_climb, right) = _climb_and_bearing(self.left), _climb_and_bearing(self.right)
        order = np.argsort(right_climb)
        other = np.interp(left_climb, right_climb[order], right[order], left=np.nan, right=np.nan)
        return 0.5 * (left + other)[np.isfinite(other)]

    def axis(self) -> float:
        """x [m] of a vertical axis in the plane y = 0: median over the heights of the bisector of both edges."""
        angle = self.bisectors()
        return float(np.median(self.eye[0] - self.eye[1] * np.tan(angle))) if len(angle) else float("nan")


def _climb_and_bearing(
    way: Float[np.ndarray, "rows 3"],
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """How steep lines of sight climb, and their angle from the plane x = 0 [rad]."""
    return way[:, 2] / np.hypot(way[:, 0], way[:, 1]), np.arctan2(way[:, 0], way[:, 1])


def rays(camera: Camera, pixels: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
    """Unit directions in the room of the lines of sight at pixels."""
    return _turned(camera.normalise(pixels), camera)


def _turned(plane: Float[np.ndarray, "points 2"], camera: Camera) -> Float[np.ndarray, "points 3"]:
    turned = np.column_stack([plane, np.ones(len(plane))]) @ camera.rotation
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


@dataclass(frozen=True)
class Outline:
    """The same in the axes of the camera, which do not ask where it stands: directions at depth 1, the lens undone."""

    rows: Float[np.ndarray, " rows"]
    left: Float[np.ndarray, "rows 2"]
    right: Float[np.ndarray, "rows 2"]
    top: Float[np.ndarray, "columns 2"]
    bottom: Float[np.ndarray, "columns 2"]

    def seen_by(self, camera: Camera) -> Sight:
        """Lines of sight in the room of a camera with the same lens."""
        sides = (_turned(plane, camera) for plane in (self.left, self.right, self.top, self.bottom))
        return Sight(camera.center, self.rows, *sides)


def outline_of(edges: MaskEdges, camera: Camera) -> Outline:
    """Outline of a mask, without rows whose width leaps away from that of their neighbours."""
    both = np.isfinite(edges.left) & np.isfinite(edges.right)
    rows, left, right = edges.rows[both], edges.left[both], edges.right[both]
    if len(rows) > 4:
        calm = (np.abs(left - _middle(left)) < STRAY) & (np.abs(right - _middle(right)) < STRAY)
        calm[[0, 1, -2, -1]] = True
        rows, left, right = rows[calm], left[calm], right[calm]
    seen = np.isfinite(edges.top)
    columns = edges.columns[seen]
    return Outline(
        rows=rows,
        left=camera.normalise(np.column_stack([left, rows])),
        right=camera.normalise(np.column_stack([right, rows])),
        top=camera.normalise(np.column_stack([columns, edges.top[seen]])),
        bottom=camera.normalise(np.column_stack([columns, edges.bottom[seen]])),
    )


def sight_of(edges: MaskEdges, camera: Camera) -> Sight:
    """Lines of sight of the outline of a mask (see `outline_of`)."""
    return outline_of(edges, camera).seen_by(camera)


def _middle(values: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Median of five neighbours."""
    padded = np.pad(values, 2, mode="edge")
    return np.asarray(np.median(np.stack([padded[k : k + len(values)] for k in range(5)]), axis=0))
