"""What the sub-step form for liquids learns: dimensionless profiles of distance (DESIGN 4.2, "many cheap local steps").

Two particles act on each other, and a wall acts on a particle, through profiles of `q` = distance over particle
spacing. Every profile is a textbook one (gradients of the Wendland C2 kernel, the pair friction of Monaghan and
Cleary, their integrals over the wall, `WallTables`) times a Bernstein polynomial of `q / cutoff` with a few positive
coefficients, whose logarithms are learned. So a profile never changes its sign, zeros are the textbook, and a liquid of
another density, viscosity or spacing stays in range.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from jaxtyping import Float

ROWS = 256  # rows of a table
ABSENT = -4.0  # logarithm of a profile that the textbook does not have
DEGREE = 3  # of the largest polynomial that the kernel takes

# Of pairs: pressure; friction along the line of centres, in all directions, of approaching particles (a
# shock); diffusion of the strain.
PAIR_PROFILES = ("pressure", "normal", "isotropic", "shock", "diffusion")
# Of walls: factors, over the distance, of the integrals over the wall: pressure, friction, and how much the missing
# share of the support widens velocities along the wall.
WALL_PROFILES = ("wall_pressure", "wall_friction", "wall_widening")
PROFILES = (*PAIR_PROFILES, *WALL_PROFILES)


@dataclass
class ParticleProfiles:
    """Learned coefficients: `coefficients` [profiles, degree + 1] log factors, `cutoff` in spacings."""

    cutoff: float
    coefficients: Float[np.ndarray, "profiles terms"]

    def pack(self) -> Float[np.ndarray, " parameters"]:
        """All that is learned as one vector."""
        return self.coefficients.ravel().copy()

    def like(self, vector: Float[np.ndarray, " parameters"]) -> ParticleProfiles:
        """The inverse of `pack`."""
        return ParticleProfiles(self.cutoff, vector.reshape(self.coefficients.shape).copy())

    def tables(self) -> tuple[Float[np.ndarray, "pair powers"], Float[np.ndarray, "rows wall"]]:
        """Profiles as the kernel reads them, with t = q / cutoff.

        Pairs: polynomials in t (lowest power first) that go with the slope (1 - t)^3 of the Wendland kernel. Walls:
        factors at equal steps of t over [0, 1], two rows more for interpolation.
        """
        degree = self.coefficients.shape[1] - 1
        positive = np.exp(np.clip(self.coefficients, -30.0, 5.0))
        powers = np.zeros((len(PAIR_PROFILES), DEGREE + 1))
        powers[:, : degree + 1] = wendland_slope(self.cutoff) * positive[: len(PAIR_PROFILES)] @ _powers(degree)
        t = np.minimum(np.arange(ROWS + 2) / ROWS, 1.0)[:, None]
        wall = t ** np.arange(degree + 1) @ (positive[len(PAIR_PROFILES) :] @ _powers(degree)).T
        return np.ascontiguousarray(powers), np.ascontiguousarray(wall)


def start_profiles(cutoff: float, degree: int) -> ParticleProfiles:
    """Profiles before any learning: the textbook, with next to no isotropic friction."""
    coefficients = np.zeros((len(PROFILES), degree + 1))
    coefficients[PROFILES.index("isotropic")] = ABSENT
    return ParticleProfiles(cutoff, coefficients)


def _powers(degree: int) -> Float[np.ndarray, "terms powers"]:
    """Bernstein polynomials of t as rows of coefficients, lowest power first."""
    out = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        for power in range(k, degree + 1):
            out[k, power] = comb(degree, power) * comb(power, k) * (-1) ** (power - k)
    return out


def wendland_slope(cutoff: float) -> float:
    """|W'| / q of the Wendland C2 kernel of radius `cutoff` (in spacings) over (1 - q / cutoff)^3.

    Pair profiles of SPH follow from it: pressure |W'| / q, friction 10 |W'| / q (Monaghan and Cleary), shock 3 |W'| / q
    (Riemann-like impulse of approaching particles, DESIGN 3.2).
    """
    return 105.0 / (16 * np.pi * (0.5 * cutoff) ** 5)
