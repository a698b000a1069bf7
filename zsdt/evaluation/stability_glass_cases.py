"""Hard cases of liquids in glasses, as data: the vessel, how full it is, how it was moved, of how many particles.

A case is reproducible by its name. The first frame that the network gets (t0) is that in which the vessel has stopped.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from zsdt.fluid.motion import Excitation, VelocityChange
from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselFamily, VesselShape

FPS = 60.0
LEAD = 8  # frames of even motion that a camera sees before the stop


class Beginning(StrEnum):
    """moved: the vessel comes along and stops. leaning: it stands, but its liquid was at rest while it leaned. lumps:
    two lumps of liquid hang over its floor and fall. still: nothing was moved."""

    moved = "moved"
    leaning = "leaning"
    lumps = "lumps"
    still = "still"


@dataclass(frozen=True)
class GlassCase:
    """A liquid in a vessel.

    shape; fill [m] high; particles: about how many, of the solver and the network; coarse: how many the network has
    where it has fewer (0: the same). speed [m/s] and ramp [s] of the stop; lean [rad]; frames after t0, at `fps`;
    viscosity: factor on glycerin's. normal: whether this is one of the cases that say how large a normal error is.
    """

    name: str
    what: str
    shape: VesselShape
    fill: float = 0.05
    particles: int = 500
    coarse: int = 0
    beginning: Beginning = Beginning.moved
    speed: float = 0.5
    ramp: float = 0.04
    lean: float = 0.0
    frames: int = 45
    viscosity: float = 1.0
    fps: float = FPS
    normal: bool = False
    glycerin: Liquid = field(default_factory=Liquid)

    @property
    def kind(self) -> str:
        """What the case is about."""
        return "glass"

    @property
    def liquid(self) -> Liquid:
        """Glycerin as thick as the case has it."""
        g = self.glycerin
        name = g.name if self.viscosity == 1.0 else f"{g.name} x {self.viscosity:g}"
        return Liquid(name, g.density, self.viscosity * g.viscosity, g.sound_speed)

    @property
    def volume(self) -> float:
        """Of the liquid [m3]."""
        return Vessel(self.shape).volume(self.fill)

    @property
    def cost(self) -> float:
        """About how long it takes, to begin with the longest."""
        return (
            500.0
            * self.frames
            * FPS
            / self.fps
            * self.particles ** (4.0 / 3.0)
            / 4e3
            / (self.volume / 2e-4) ** (1.0 / 3.0)
        )

    def excitation(self) -> Excitation:
        """How the vessel is moved."""
        if self.beginning is not Beginning.moved:
            return Excitation((0.0, 0.0, 0.0), (VelocityChange(0.0, 0.0, (0.0, 0.0, 0.0)),))
        stop = VelocityChange(0.0, self.ramp, (-self.speed, 0.0, 0.0))
        return Excitation((self.speed, 0.0, 0.0), (stop,))


def cylinder(radius: float = 0.035, rim: float = 0.1) -> VesselShape:
    """A straight glass."""
    return VesselShape(VesselFamily.cylinder, [0.0, rim], [radius, radius])


def tumbler() -> VesselShape:
    """A glass that widens upwards."""
    return VesselShape(VesselFamily.tumbler, [0.0, 0.11], [0.028, 0.04])


def flask(neck: float = 0.013) -> VesselShape:
    """A body, a shoulder and a narrow neck."""
    s = np.linspace(0.0, 1.0, 12)
    curve = [(0.04 + 0.02 * a, neck + 0.5 * (0.035 - neck) * (1.0 + np.cos(np.pi * a))) for a in s]
    profile = [(0.0, 0.035), *curve, (0.12, neck)]
    return VesselShape(
        VesselFamily.flask, [round(float(z), 6) for z, _ in profile], [round(float(r), 6) for _, r in profile]
    )


def box() -> VesselShape:
    """A jar whose corners are nearly square."""
    return VesselShape(VesselFamily.jar, [0.0, 0.1], [0.033, 0.033], 0.8, 10.0)


GLASS_CASES = (
    GlassCase("normal_stop", "cylinder, 5 cm, stop from 0.5 m/s", cylinder(), normal=True),
    GlassCase("normal_tumbler", "tumbler, 5 cm, stop from 0.4 m/s", tumbler(), speed=0.4, normal=True),
    GlassCase("near_empty", "2 cm in a cylinder", cylinder(), fill=0.02, particles=1_000),
    GlassCase("near_full", "3 mm below the rim, slow stop", cylinder(rim=0.053), speed=0.1),
    GlassCase("spill", "3 mm below the rim, stop from 1.5 m/s", cylinder(rim=0.053), speed=1.5, ramp=0.02),
    GlassCase("stop_2mps", "stop from 2 m/s within 20 ms", cylinder(rim=0.14), speed=2.0, ramp=0.02),
    GlassCase("narrow_neck", "liquid up into a neck of 13 mm radius", flask(), fill=0.07, particles=700),
    GlassCase("square_corners", "jar with nearly square corners", box()),
    GlassCase("tilted_start", "the surface leans by 15 degrees at the start", cylinder(), lean=0.26,
              beginning=Beginning.leaning),
    GlassCase("viscosity_001", "100 x thinner than glycerin", cylinder(), viscosity=0.01, speed=0.3),
    GlassCase("viscosity_10", "10 x thicker than glycerin", cylinder(), viscosity=10.0),
    GlassCase("coarse_50", "network of 50 particles", cylinder(), coarse=50),
    GlassCase("fine_5000", "5,000 particles", cylinder(), particles=5_000, frames=12),
    GlassCase("two_lumps", "two lumps fall on the floor and meet", cylinder(), fill=0.012, particles=500,
              beginning=Beginning.lumps),
    GlassCase("rest_5000", "at rest for 5,000 frames, must stay at rest", cylinder(0.025), fill=0.04, particles=200,
              beginning=Beginning.still, frames=5_000, fps=250.0),
)  # fmt: skip
