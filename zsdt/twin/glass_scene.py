"""What the twin of a glass is told about the scene before it sees the first frame."""

from __future__ import annotations

from dataclasses import dataclass, field

from zsdt.errors import OptionError
from zsdt.fields import FIELDS
from zsdt.perception.glass_geometry import ToldGlass
from zsdt.scene import Liquid

KNOWN = ("position", "velocity", "internal_energy", "density", "pressure")


@dataclass
class GlassTwinScene:
    """A glass with a liquid in front of one camera; shape, amount and motion come from the pictures.

    liquid: the nominal card. wall, floor [m]: thickness of the glass, square to the wall and below the cavity.
    glass_index, liquid_index: of refraction. section: [aspect, exponent] of the cross-section of a prism (see
    `VesselShape`), which no picture from the front shows; None: the glass is round. gravity [m/s2] downwards. fps:
    frames per second, 0: what the video says. particles: about how many. fields: what is decoded in every frame;
    nothing else is.
    """

    liquid: Liquid = field(default_factory=Liquid)
    wall: float = 0.002
    floor: float = 0.006
    glass_index: float = 1.5
    liquid_index: float = 1.473
    section: list[float] | None = None
    gravity: float = 9.81
    fps: float = 0.0
    particles: int = 700
    fields: list[str] = field(default_factory=lambda: ["velocity"])

    def __post_init__(self) -> None:
        if self.fps < 0 or self.gravity <= 0 or self.particles < 50 or self.liquid_index < 1:
            raise OptionError(
                "Gravity of a glass scene must be positive, fps not negative, particles at least 50 and indices of "
                "refraction at least 1."
            )
        if self.section is not None and len(self.section) != 2:
            raise OptionError("section of a glass is [aspect, exponent], or nothing for a round one.")
        unknown = [name for name in self.fields if name not in KNOWN]
        if unknown:
            raise OptionError(
                f"The scene asks for the field '{unknown[0]}', which a liquid has not; known are {', '.join(KNOWN)}."
            )
        assert all(name in FIELDS for name in KNOWN)
        self.told()  # the glass checks itself

    def told(self) -> ToldGlass:
        """What of this no silhouette shows."""
        aspect, exponent = (1.0, 2.0) if self.section is None else self.section
        return ToldGlass(self.wall, self.floor, float(aspect), float(exponent), self.glass_index)
