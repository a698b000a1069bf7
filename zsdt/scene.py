"""What is in front of the camera: a material, a shape, gravity, the frame rate, and which fields are wanted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import TypeVar

import numpy as np

from zsdt.errors import OptionError

Number = TypeVar("Number", float, np.ndarray)


class Modulus(Enum):
    """What the Young's modulus of a viscoelastic material means (DESIGN 3.1)."""

    instantaneous = "instantaneous"
    long_term = "long_term"


@dataclass
class Foam:
    """Viscoelastic St. Venant-Kirchhoff foam with one Prony term (seed, Eq. 9 and Section V.A).

    Defaults are the seed's: density [kg/m3], Young's modulus [Pa], Poisson ratio [-], shear relaxation
    coefficient g1 [-] and relaxation time tau1 [s].
    """

    density: float = 18.44
    young: float = 4.5e4
    poisson: float = 0.3
    g1: float = 0.5
    tau: float = 0.05
    modulus: Modulus = Modulus.instantaneous

    def __post_init__(self) -> None:
        if not (self.density > 0 and self.young > 0 and self.tau > 0):
            raise OptionError("Density, Young's modulus and relaxation time of a foam must be positive.")
        if not -1.0 < self.poisson < 0.5:
            raise OptionError(f"Poisson ratio {self.poisson} is outside (-1, 0.5); choose one inside.")
        if not 0.0 <= self.g1 < 1.0:
            raise OptionError(f"Prony coefficient g1 = {self.g1} is outside [0, 1); choose one inside.")

    @property
    def bulk(self) -> float:
        """Bulk modulus K [Pa]. It does not relax, so it follows from E and nu of either state of the card."""
        return self.young / (3.0 * (1.0 - 2.0 * self.poisson))

    @property
    def shear(self) -> float:
        """Instantaneous shear modulus mu [Pa]; the relaxed one is (1 - g1) mu."""
        mu = self.young / (2.0 * (1.0 + self.poisson))
        return mu if self.modulus is Modulus.instantaneous else mu / (1.0 - self.g1)


@dataclass
class BeamShape:
    """A brick clamped at x = 0: length (x), width (y, into the picture) and depth (z, vertical), all in m."""

    length: float = 0.55
    width: float = 0.2
    depth: float = 0.2

    def __post_init__(self) -> None:
        if min(self.length, self.width, self.depth) <= 0:
            raise OptionError("Length, width and depth of a beam must be positive.")


@dataclass
class BeamScene:
    """One beam in front of one camera. `frame_dt` [s] is the time between frames, `pitch` [m] the graph's grid."""

    material: Foam = field(default_factory=Foam)
    shape: BeamShape = field(default_factory=BeamShape)
    gravity: float = 9.81
    pitch: float = 0.05
    frame_dt: float = 1.0 / 60.0
    fields: list[str] = field(default_factory=lambda: ["position", "velocity", "stress"])


@dataclass
class Liquid:
    """Slightly compressible viscous liquid (seed, Section V.B): linear Us-Up equation of state.

    Defaults are the seed's glycerin: density [kg/m3], dynamic viscosity [Pa s], reference speed of sound [m/s]. The
    speed is far below the real one, as is usual: what counts is that the liquid stays much slower than it.
    """

    name: str = "glycerin"
    density: float = 1261.0
    viscosity: float = 1.412
    sound_speed: float = 13.0

    def __post_init__(self) -> None:
        if not (self.density > 0 and self.sound_speed > 0 and self.viscosity >= 0):
            raise OptionError("Density and speed of sound of a liquid must be positive, its viscosity not negative.")

    def pressure(self, density: Number) -> Number:
        """p = rho0 c0^2 (1 - rho0 / rho) [Pa] (seed, Section V.B); `density` [kg/m3], a number or an array."""
        return self.density * self.sound_speed**2 * (1.0 - self.density / density)


def water(sound_speed: float = 13.0) -> Liquid:
    """Water at 20 degrees Celsius, the liquid that a network is trained on before it meets glycerin (seed, V.B)."""
    return Liquid("water", density=998.0, viscosity=1.0e-3, sound_speed=sound_speed)


class VesselFamily(Enum):
    """Kinds of glasses: what a person calls them; the shape itself is the profile and the cross-section."""

    cylinder = "cylinder"
    tumbler = "tumbler"
    bowl = "bowl"
    flask = "flask"
    jar = "jar"


@dataclass
class VesselShape:
    """Cavity of an upright vessel with a flat bottom at z = 0, symmetric about the z axis or an upright prism.

    heights, radii [m]: inner profile from the bottom (0) to the rim, straight between its points; the radius is the
    half-width along x. aspect: half-width along y over the one along x. exponent: of the superellipse
    `|x/a|^n + |y/b|^n = 1` that is the cross-section (2: ellipse; larger: a box with rounded corners). A vessel is
    either round (aspect 1, exponent 2) or a prism (one radius at all heights): only these have an exact distance.
    """

    family: VesselFamily = VesselFamily.cylinder
    heights: list[float] = field(default_factory=lambda: [0.0, 0.12])
    radii: list[float] = field(default_factory=lambda: [0.035, 0.035])
    aspect: float = 1.0
    exponent: float = 2.0

    def __post_init__(self) -> None:
        if len(self.heights) != len(self.radii) or len(self.heights) < 2:
            raise OptionError("A vessel needs as many radii as heights, at least two of each.")
        if self.heights[0] != 0.0 or any(b <= a for a, b in zip(self.heights, self.heights[1:], strict=False)):
            raise OptionError("Heights of a vessel must start at 0 and rise.")
        if min(self.radii) <= 0 or self.aspect <= 0 or self.exponent < 2:
            raise OptionError("Radii and aspect of a vessel must be positive and its exponent at least 2.")
        if not (self.is_round or self.is_prism):
            raise OptionError("A vessel must be round (aspect 1, exponent 2) or a prism (one radius at all heights).")

    @property
    def is_round(self) -> bool:
        """Whether it is a body of revolution."""
        return math.isclose(self.aspect, 1.0) and math.isclose(self.exponent, 2.0)

    @property
    def is_prism(self) -> bool:
        """Whether its cross-section is the same at all heights."""
        return max(self.radii) - min(self.radii) <= 1e-9 * max(self.radii)

    @property
    def rim(self) -> float:
        """Height of the rim [m]."""
        return self.heights[-1]
