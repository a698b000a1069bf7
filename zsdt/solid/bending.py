"""Closed forms of a cantilever that bends under its weight and a mass at its tip: the start of every material fit.

Euler-Bernoulli bending with Timoshenko's shear (Cowper's factor for a rectangle), small displacements. Gravity is
given in the axes of the beam (x from the clamp to the tip, z up); only its part along z bends here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from zsdt.errors import DataError, OptionError
from zsdt.scene import BeamShape


@dataclass(frozen=True)
class Cantilever:
    """A brick clamped at x = 0 with a point mass at its tip.

    density [kg/m3], tip_mass [kg], gravity [3] m/s2 in beam axes, poisson [-] for the shear alone.
    """

    shape: BeamShape
    density: float
    tip_mass: float = 0.0
    gravity: Float[np.ndarray, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    poisson: float = 0.45

    def __post_init__(self) -> None:
        if self.density <= 0 or self.tip_mass < 0:
            raise OptionError("A cantilever needs a positive density and a tip mass that is not negative.")

    @property
    def mass(self) -> float:
        """Mass of the beam alone [kg]."""
        return self.density * self.shape.length * self.shape.width * self.shape.depth

    def deflection(
        self, x: Float[np.ndarray, " points"], young: float, shear: bool = True
    ) -> Float[np.ndarray, " points"]:
        """Displacement [m] along z (down is negative) at distances `x` [m] from the clamp for a modulus [Pa].

        `q x^2 (6 L^2 - 4 L x + x^2) / 24 E I` of the weight q per length, `P x^2 (3 L - x) / 6 E I` of the tip mass,
        and the shear `(q (L x - x^2 / 2) + P x) / kappa G A`.
        """
        length, area = self.shape.length, self.shape.width * self.shape.depth
        second_moment = area * self.shape.depth**2 / 12.0
        q, p = self.mass / length * self.gravity[2], self.tip_mass * self.gravity[2]
        bent = q * x**2 * (6.0 * length**2 - 4.0 * length * x + x**2) / 24.0 + p * x**2 * (3.0 * length - x) / 6.0
        result = bent / (young * second_moment)
        if shear:
            modulus = young / (2.0 * (1.0 + self.poisson))
            result = result + (q * (length * x - 0.5 * x**2) + p * x) / (self._kappa * modulus * area)
        return result

    @property
    def _kappa(self) -> float:
        return 10.0 * (1.0 + self.poisson) / (12.0 + 11.0 * self.poisson)

    def tip_drop(self, young: float, shear: bool = True) -> float:
        """Fall of the tip [m] along -z."""
        return -float(self.deflection(np.array([self.shape.length]), young, shear)[0])

    def young_from_shape(
        self, x: Float[np.ndarray, " points"], z: Float[np.ndarray, " points"], shear: bool = True
    ) -> float:
        """Modulus [Pa] whose deflection fits displacements `z` [m] at `x` [m] best (least squares).

        Raises: DataError where the shape does not bend the way that gravity pulls.
        """
        unit = self.deflection(x, 1.0, shear)
        along = float(unit @ z)
        if not along > 0:
            raise DataError("The observed shape does not sag under gravity; check the axes and the straight shape.")
        return float(unit @ unit) / along

    def frequency(self, young: float, shear: bool = True) -> float:
        """First bending frequency [Hz] in the plane of gravity, undamped, without the stiffness of axial forces.

        Bending: `1 + cos b cosh b + mu b (cos b sinh b - sin b cosh b) = 0` with mu = tip mass / beam mass; shear:
        `b tan b = 1 / mu`; in series (Southwell-Dunkerley).
        """
        mu, length = self.tip_mass / self.mass, self.shape.length

        def bending(b: float) -> float:
            c, s, ch, sh = math.cos(b), math.sin(b), math.cosh(b), math.sinh(b)
            return 1.0 + c * ch + mu * b * (c * sh - s * ch)

        b = brentq(bending, 1e-3, 1.9)
        bent = b**2 / (2.0 * math.pi * length**2) * math.sqrt(young * self.shape.depth**2 / 12.0 / self.density)
        if not shear:
            return float(bent)
        b = 0.5 * math.pi if mu == 0 else brentq(lambda b: mu * b * math.sin(b) - math.cos(b), 1e-6, 0.5 * math.pi)
        modulus = young / (2.0 * (1.0 + self.poisson))
        sheared = b / (2.0 * math.pi * length) * math.sqrt(self._kappa * modulus / self.density)
        return float(1.0 / math.hypot(1.0 / bent, 1.0 / sheared))
