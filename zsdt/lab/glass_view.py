"""What a camera of the virtual laboratory is asked to show of glasses, and what it gives back.

Axes of the room: x right in the picture, y into it, z up; the origin is on the table under the floor of the vessel at
rest. Axes of a vessel: origin at the centre of its cavity's floor, parallel to those of the room.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.lab.glass_styles import GlassStyle
from zsdt.perception.camera import Camera
from zsdt.scene import VesselShape


@dataclass(frozen=True)
class Glass:
    """One glass, upright, with or without liquid.

    vessel: its cavity. wall, floor [m]: thickness of the glass of the wall, square to it, and below the cavity.
    origin [3] m: centre of the cavity's floor in the room. height [rings, angles] m: the free surface over a polar
    grid, in the axes of the vessel (see `zsdt.lab.glass_surface`): ring k lies at the share k / (rings - 1) of the way
    from the axis to the contact line, column j at the angle 2 pi j / angles from x to y; all values of ring 0 are the
    height at the axis, those of the last ring are the contact line on the wall. None: empty. glass_index,
    liquid_index: of refraction (glycerin 1.473, water 1.333).
    """

    vessel: VesselShape
    wall: float
    floor: float
    origin: Float[np.ndarray, "3"]
    height: Float[np.ndarray, "rings angles"] | None
    glass_index: float = 1.5
    liquid_index: float = 1.473

    def __post_init__(self) -> None:
        if min(self.wall, self.floor) <= 0 or min(self.glass_index, self.liquid_index) <= 1.0:
            raise OptionError("Wall and floor of a glass must be thicker than 0, its indices of refraction above 1.")


@dataclass(frozen=True)
class GlassView:
    """What one picture shows.

    glasses: none, one or more, beside each other and not behind each other. style: see `zsdt.lab.glass_styles`.
    camera: at rest; its `width` and `height` are the size of the picture. shake [3] rad: rotation of the camera about
    itself in this picture (`zsdt.lab.beam_painter.shaken`). moments: how many such views make one exposure, so that a
    camera may look less carefully at each.
    """

    glasses: tuple[Glass, ...]
    style: GlassStyle
    camera: Camera
    shake: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    moments: int = 1


@dataclass(frozen=True)
class Shot:
    """A picture with its truth, before exposure and noise.

    image: BGR as displayed (gamma-coded), 0 to 255, float32. container_mask: cover 0 to 255 of the glasses with all
    that is seen through them. liquid_mask: cover of the *apparent* liquid, a part of the container: pixels whose line
    of sight, refracted through the glass (and reflected where it must, but not in its base), meets liquid within six
    surfaces.
    """

    image: Float[np.ndarray, "height width 3"]
    container_mask: UInt8[np.ndarray, "height width"]
    liquid_mask: UInt8[np.ndarray, "height width"]


GlassPicture = Callable[[GlassView], Shot]
"""A camera: `zsdt.lab.glass_painter.GlassPainter` or the ray tracer. It may keep what does not change between views
of the same style and camera (compared by identity), so one object films one clip."""


def outer_profile(
    vessel: VesselShape, wall: float, floor: float
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Heights [m] and radii [m] of the outside of a glass, from its foot at -floor to the rim.

    Points of the inner profile are moved by `wall` [m] along the normal of the wall; below the cavity the outside goes
    straight down, and its highest point is at the height of the rim. Radii are half-widths along x; those of a prism
    along y are larger than those of its cavity by the same length.
    """
    z, r = np.asarray(vessel.heights, np.float64), np.asarray(vessel.radii, np.float64)
    slope = np.gradient(r, z) if len(z) > 2 else np.full(2, (r[1] - r[0]) / (z[1] - z[0]))
    length = np.sqrt(1.0 + slope**2)
    height, radius = z - wall * slope / length, r + wall / length
    height[-1] = z[-1]
    keep = np.concatenate([[True], height[1:] > np.maximum.accumulate(height)[:-1] + 1e-6])
    height, radius = height[keep], radius[keep]
    above = height > -floor + 1e-6
    start = float(np.interp(-floor, height, radius))
    return np.concatenate([[-floor], height[above]]), np.concatenate([[start], radius[above]])
