"""What the motion of a vessel leaves in its liquid: memories of the pushes that it gave, fading and swinging.

In the axes of the vessel its liquid is pushed by `-a`, and by the change of gravity where the vessel tilts (to first
order in the tilt). A push fades within some time constant, which nobody knows beforehand, so several are kept; and its
first sloshing mode swings back, so that a pulse and a later stop may add up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.trajectory import VesselMotion

FADING = (0.01, 0.03, 0.1, 0.3)  # s
# Damping of the first sloshing mode by viscosity, in kinematic viscosities over the squared radius. Glycerin in a glass
# of 3.5 cm is at 10 (DESIGN 3.2: damping ratio 0.45 to 0.5).
DAMPING = (5.0, 15.0)
MEMORIES = len(FADING) + len(DAMPING)


@dataclass(frozen=True)
class Swing:
    """First sloshing mode of a liquid: frequency [1/s] without damping, dampings [1/s] that it might have."""

    frequency: float
    dampings: tuple[float, ...]


def swing_of(radius: float, depth: float, gravity: float, viscosity: float) -> Swing:
    """Mode of a cylinder of `radius` and `depth` [m] (Lamb, art. 257: k R = 1.841); kinematic viscosity [m2/s]."""
    k = 1.841 / radius
    return Swing(math.sqrt(gravity * k * math.tanh(k * depth)), tuple(c * viscosity / radius**2 for c in DAMPING))


@dataclass(frozen=True)
class History:
    """What is left of the pushes, memory by memory: first those that fade, then those that swing.

    pushes [memories, 3] m/s: the velocity that a mass would have; spent [memories] J/kg: the energy that it would
    have lost.
    """

    pushes: Float[np.ndarray, "memories 3"]
    spent: Float[np.ndarray, " memories"]

    @property
    def speed(self) -> float:
        """Scale of the velocity that is left [m/s]: root mean square over the memories."""
        return float(np.sqrt((self.pushes**2).sum(1).mean()))

    @property
    def heat(self) -> float:
        """Scale of the internal energy [J/kg]: energy spent and left, mean over the memories."""
        return float((self.spent + 0.5 * (self.pushes**2).sum(1)).mean())


class _Masses:
    """One mass per memory on a damper, or on a spring and a damper, and the work that pushes have done on it."""

    def __init__(self, swing: Swing):
        damping = np.array([1.0 / t for t in FADING] + list(swing.dampings))
        self.stiffness = np.array([0.0] * len(FADING) + [swing.frequency**2] * len(DAMPING))
        # x'' = -2 b x' - w^2 x; those that fade have w = 0 and 2 b = 1 / memory.
        self.half = np.where(self.stiffness > 0, damping, 0.5 * damping)
        self.root = np.sqrt((self.stiffness - self.half**2).astype(complex))
        self.place, self.velocity = np.zeros((MEMORIES, 3)), np.zeros((MEMORIES, 3))
        self.work = np.zeros(MEMORIES)

    def push(self, kick: Float[np.ndarray, "3"]) -> None:
        """Changes all velocities [m/s] at once."""
        self.work += self.velocity @ kick + 0.5 * kick @ kick
        self.velocity += kick

    def wait(self, duration: float) -> None:
        """Lets them go on for `duration` [s]; exact."""
        shrink = np.exp(-self.half * duration)
        swung = np.where(np.abs(self.root) * duration > 1e-9, self.root, 1e-9)
        cos, sin = np.cos(self.root * duration).real, (np.sin(swung * duration) / swung).real
        forth, back = (shrink * (cos + self.half * sin))[:, None], (shrink * (cos - self.half * sin))[:, None]
        across = (shrink * sin)[:, None]
        x, v = self.place, self.velocity
        self.place, self.velocity = forth * x + across * v, back * v - self.stiffness[:, None] * across * x

    def energy(self) -> Float[np.ndarray, " memories"]:
        """Kinetic and spring energy [J/kg]."""
        return 0.5 * (self.velocity**2).sum(1) + 0.5 * self.stiffness * (self.place**2).sum(1)


def history_of(motion: VesselMotion | None, swing: Swing, later: float = 0.0) -> History:
    """Memories of a motion at `later` [s] after its last sample; the vessel stands still in between.

    Raises: OptionError where nothing is known of the motion.
    """
    if motion is None:
        raise OptionError("Psi_ini of a liquid needs to know how its vessel moved; this body does not say it.")
    steps = np.diff(motion.times)
    tilt = 0.5 * (motion.gravity[1:] + motion.gravity[:-1]) - motion.gravity[-1]
    kicks = -np.diff(motion.velocity, axis=0) + tilt * steps[:, None]
    masses = _Masses(swing)
    for kick, step in zip(kicks, steps, strict=True):
        masses.wait(0.5 * step)
        masses.push(kick)
        masses.wait(0.5 * step)
    masses.wait(later)
    return History(masses.velocity, masses.work - masses.energy())
