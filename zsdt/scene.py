"""What is in front of the camera: a material, a shape, gravity, the frame rate, and which fields are wanted."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from zsdt.errors import OptionError


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
