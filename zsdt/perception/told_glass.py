"""What is told of a glass because no silhouette shows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zsdt.errors import OptionError


@dataclass
class ToldGlass:
    """What the scene says of a glass that no silhouette shows.

    wall [m]: thickness of the wall, square to it; floor [m]: of glass below the cavity. aspect, exponent: of the
    cross-section (see `VesselShape`); round by default. glass_index: of refraction. camera_doubt [rad], height_doubt
    [m]: standard deviations of the angles and of the height of the camera that is told; outlines of rim and foot are
    believed more where they are sharper than that.
    """

    wall: float = 0.002
    floor: float = 0.006
    aspect: float = 1.0
    exponent: float = 2.0
    glass_index: float = 1.5
    foot_edge: float = 0.0015
    camera_doubt: float = 0.003
    height_doubt: float = 0.002

    def __post_init__(self) -> None:
        if min(self.wall, self.floor, self.aspect) <= 0 or self.exponent < 2 or self.glass_index < 1:
            raise OptionError(
                "Wall, floor and aspect of a glass must be positive, its exponent at least 2 and its index at least 1."
            )
        if min(self.camera_doubt, self.height_doubt) <= 0 or self.foot_edge < 0:
            raise OptionError("camera_doubt and height_doubt of a glass must be positive, foot_edge not negative.")

    @property
    def is_round(self) -> bool:
        """Whether it is a body of revolution."""
        return bool(np.isclose(self.aspect, 1.0) and np.isclose(self.exponent, 2.0))
