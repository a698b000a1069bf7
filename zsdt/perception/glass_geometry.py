"""A glass from its silhouette: where its axis stands, its outside, and the cavity inside of it.

The silhouette of a body of revolution is not its profile: a line of sight touches it where the outside turns away from
the camera, nearer than the axis and, on a sloping wall, at another height (Wong, Mendonca and Cipolla, IEEE PAMI 2003).
Each row of the picture gives the line of sight at the edge; the point where it touches follows from its nearest
approach to the axis and the slope of the profile, which a few rounds settle. Wall and floor are told, because no
silhouette shows them. Cameras look at the glass from the side, with the plane of motion y = 0 through its axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError
from zsdt.perception.camera import Camera
from zsdt.perception.glass_pose import mended_camera
from zsdt.perception.glass_profile import OuterProfile, as_shape, outer_profile_of, prism_half_widths, simplified
from zsdt.perception.glass_rays import GlassWalls
from zsdt.perception.glass_sight import Sight, sight_of
from zsdt.perception.mask_edges import MaskEdges
from zsdt.perception.told_glass import ToldGlass
from zsdt.scene import VesselShape

__all__ = ["ToldGlass", "VesselFit", "axis_of", "fit_vessel"]
ROUNDS = 3  # of camera and profile, each with the other as found before
CONTRADICTS = 8.0  # doubts by which a camera may differ from what was told
NEAR_REST = 0.01  # m
ENOUGH = 4  # pictures


@dataclass(frozen=True)
class VesselFit:
    """A glass as found.

    shape: its cavity. outer [points, 2] m: half-width along x and height above the table of its outside. x [m]: of its
    axis in the room in the last of the frames. camera: the told one with angles and height mended, so that the
    glass stands on the table. walls: for lines of sight. notes: figures by name (px, m, rad) for a person.
    """

    shape: VesselShape
    outer: Float[np.ndarray, "points 2"]
    told: ToldGlass
    camera: Camera
    x: float
    walls: GlassWalls
    notes: dict[str, float] = field(default_factory=dict)

    def origin(self, x: float | None = None) -> Float[np.ndarray, "3"]:
        """Centre of the cavity's floor [m] in the room, with the axis at `x` [m]."""
        return np.array([self.x if x is None else x, 0.0, self.told.floor])


def axis_of(edges: MaskEdges, camera: Camera) -> float:
    """x [m] of the axis: where the bisectors of the lines of sight at both edges meet the plane y = 0; NaN where no
    row has both edges. Exact for any body of revolution; the median over the rows forgives what covers a few."""
    sight = sight_of(edges, camera)
    return sight.axis() if len(sight.rows) else float("nan")


def fit_vessel(edges: Sequence[MaskEdges], camera: Camera, told: ToldGlass) -> VesselFit:
    """The glass seen in some pictures (median over them), in which it may move along x, the last at rest.

    Its size is that in the pictures within `NEAR_REST` of where it is in the last: a glass that is not moved quite
    along x is nearer or farther elsewhere, and a hundredth of the distance is three of the volume.

    Raises: DataError where no picture shows a whole glass.
    """
    whole = [e for e in edges if e.has_glass and not (e.touches("left") or e.touches("right") or e.touches("bottom"))]
    if not whole:
        raise DataError(
            "No picture shows a whole glass (it is missing or the border cuts it off); move the camera back, or start "
            "the clip where the glass stands free in the picture."
        )
    closed = not any(e.touches("top") for e in whole)
    whole, others = _near_rest(whole, camera)
    mended = camera
    notes: dict[str, float] = {}
    sights = [sight_of(e, camera) for e in whole]
    profile = outer_profile_of(sights, told, closed)
    for _ in range(ROUNDS):
        mended, notes = mended_camera(whole, camera, profile, told)
        sights = [sight_of(e, mended) for e in whole]
        profile = outer_profile_of(sights, told, closed, [sight_of(e, mended) for e in others])
    _check_stance(notes, told)
    shape = as_shape(profile, told)
    return VesselFit(
        shape=shape,
        outer=np.column_stack([profile.radii, profile.heights]),
        told=told,
        camera=mended,
        x=_place(sights[-1], told),
        walls=_walls(profile, shape, told),
        notes={**notes, "frames": float(len(whole)), "rim": float(profile.heights[-1])},
    )


def _place(sight: Sight, told: ToldGlass) -> float:
    """x [m] of the axis: of a prism so that both edges have it equally wide."""
    if told.is_round:
        return sight.axis()
    left, right = prism_half_widths(sight, told)
    return sight.axis() + 0.5 * (right - left)


def _check_stance(notes: dict[str, float], told: ToldGlass) -> None:
    """Refuses an outline that only a camera quite unlike the told one would see of a glass on a table."""
    off = max(abs(notes["pitch"]) / told.camera_doubt, abs(notes["lift"]) / told.height_doubt)
    if off > CONTRADICTS:
        raise DataError(
            f"The outline of the glass does not stand on the table: its foot is {notes['foot_px']:.0f} px from where "
            "the told camera expects it. Correct height, angle and distance of the camera, or improve the masks."
        )


def _near_rest(edges: list[MaskEdges], camera: Camera) -> tuple[list[MaskEdges], list[MaskEdges]]:
    """Pictures in which the glass is near its last place, if they are enough, else all; and the others."""
    near = np.abs(np.array([axis_of(e, camera) for e in edges]) - axis_of(edges[-1], camera)) < NEAR_REST
    if near.sum() < ENOUGH:
        return edges, []
    return [e for e, n in zip(edges, near, strict=True) if n], [e for e, n in zip(edges, near, strict=True) if not n]


def _walls(profile: OuterProfile, shape: VesselShape, told: ToldGlass) -> GlassWalls:
    if told.is_round:
        heights, radii = simplified(profile)
        return GlassWalls.inside_of(heights - told.floor, radii, told.wall, told.glass_index)
    return GlassWalls.of(shape, told.wall, told.floor, told.glass_index)
