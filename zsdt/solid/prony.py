"""One Prony term seen from a free vibration: complex moduli, and the material that has them.

A linear viscoelastic beam that swings freely moves as `exp(s t)` with the complex frequency
`s = i omega - decay`. With elastic bulk and a shear modulus `mu(s) = mu_inf + D s tau / (1 + s tau)` (DESIGN 3.1), its
Young's modulus `E(s) = 9 K mu / (3 K + mu)` obeys `E(s) = -M s^2`, where M holds mass and geometry. So one recording
gives one complex number, that is two equations, for three unknowns (relaxed modulus, g1, tau): one frequency alone
fixes storage modulus and loss factor, never g1 and tau one by one. What fixes the rest is a choice, `PronyChoice`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from scipy.optimize import minimize_scalar

from zsdt.errors import RunRejected
from zsdt.scene import Foam, Modulus

SLOWEST, FASTEST = 0.02, 50.0  # omega tau between which a relaxation time is sought


class PronyChoice(Enum):
    """What fixes g1 and tau beside frequency and damping.

    static_ratio: the modulus of the static shape is the relaxed one. It identifies all three, but by the difference
    of two moduli: good only where the straight shape is known well and the static load was waited for.
    least_g1: the smallest g1 that explains the damping; its loss factor is at its peak near the observed frequency.
    given_tau: the caller says tau.
    """

    static_ratio = "static_ratio"
    least_g1 = "least_g1"
    given_tau = "given_tau"


@dataclass(frozen=True)
class MaterialFamily:
    """What is taken as known: density [kg/m3], Poisson ratio, and of which state (see `Foam`) that ratio is."""

    density: float
    poisson: float
    state: Modulus = Modulus.long_term

    def material(self, shear: float, g1: float, tau: float) -> Foam:
        """The material with relaxed shear modulus `shear` [Pa]."""
        of_state = shear if self.state is Modulus.long_term else shear / (1.0 - g1)
        young = 2.0 * (1.0 + self.poisson) * of_state
        return Foam(self.density, young, self.poisson, g1, tau, self.state)

    def elastic(self, young: float) -> Foam:
        """The material without memory."""
        return Foam(self.density, young, self.poisson, 0.0, 1.0, self.state)


def complex_frequency(frequency: float, damping: float) -> complex:
    """s [1/s] of a swing with a seen frequency [Hz] and damping ratio."""
    omega = 2.0 * math.pi * frequency
    return complex(-omega * damping / math.sqrt(1.0 - damping**2), omega)


def relaxed_young(material: Foam) -> float:
    """Young's modulus [Pa] of a load that was there for long."""
    mu, bulk = (1.0 - material.g1) * material.shear, material.bulk
    return 9.0 * bulk * mu / (3.0 * bulk + mu)


def complex_young(material: Foam, s: complex) -> complex:
    """Young's modulus [Pa] at the complex frequency s [1/s]; storage modulus and loss where s is imaginary."""
    turn = s * material.tau
    mu = material.shear * (1.0 - material.g1 + material.g1 * turn / (1.0 + turn))
    return 9.0 * material.bulk * mu / (3.0 * material.bulk + mu)


def loss_factor(material: Foam, frequency: float) -> float:
    """Loss modulus over storage modulus of bending at `frequency` [Hz]; about twice the damping ratio."""
    modulus = complex_young(material, 2j * math.pi * frequency)
    return modulus.imag / modulus.real


def from_static_ratio(family: MaterialFamily, static: float, modulus: complex, s: complex) -> Foam:
    """The material with relaxed Young's modulus `static` [Pa] and `modulus` [Pa] at s (exact).

    Raises: RunRejected where no Prony term joins them, as when the static shape looks stiffer than the vibration.
    """

    def of_bulk(bulk: float) -> Foam:
        relaxed = 3.0 * bulk * static / (9.0 * bulk - static)
        difference = _shear(modulus, bulk) - relaxed
        slope = s / difference
        strength = s.imag / slope.imag if slope.imag != 0 else -1.0
        rate = strength * slope.real - s.real
        if strength <= 0 or rate <= 0:
            raise RunRejected(
                "static_ratio",
                f"The static shape gives a relaxed modulus of {static:.3g} Pa and the vibration a storage modulus of "
                f"{modulus.real:.3g} Pa with too little or too much damping for one Prony term between them; use "
                "least_g1 or given_tau, or measure the straight shape better.",
            )
        return family.material(relaxed, strength / (strength + relaxed), 1.0 / rate)

    return _with_own_bulk(of_bulk, static, family)


def from_given_tau(family: MaterialFamily, modulus: complex, s: complex, tau: float) -> Foam:
    """The material with relaxation time `tau` [s] and `modulus` [Pa] at s (exact).

    Raises: RunRejected where the damping is more than one Prony term of this tau can give.
    """
    turn = s * tau / (1.0 + s * tau)

    def of_bulk(bulk: float) -> Foam:
        shear = _shear(modulus, bulk)
        strength = shear.imag / turn.imag
        relaxed = shear.real - strength * turn.real
        if strength < 0 or relaxed <= 0:
            raise RunRejected(
                "damping", f"No Prony term with tau = {tau:.3g} s damps like this; choose another tau or least_g1."
            )
        return family.material(relaxed, strength / (strength + relaxed), tau)

    return _with_own_bulk(of_bulk, modulus.real, family)


def from_least_g1(family: MaterialFamily, modulus: complex, s: complex) -> Foam:
    """The material with `modulus` [Pa] at s whose g1 is smallest.

    Raises: RunRejected where the damping is more than one Prony term can give.
    """

    def g1(logarithm: float) -> float:
        try:
            return from_given_tau(family, modulus, s, math.exp(logarithm)).g1
        except RunRejected:
            return 2.0

    low, high = math.log(SLOWEST / s.imag), math.log(FASTEST / s.imag)
    coarse = [low + (high - low) * k / 40 for k in range(41)]
    best = min(coarse, key=g1)
    step = (high - low) / 40
    found = minimize_scalar(g1, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-6})
    return from_given_tau(family, modulus, s, math.exp(float(found.x)))


def _shear(young: complex, bulk: float) -> complex:
    return 3.0 * bulk * young / (9.0 * bulk - young)


def _with_own_bulk(of_bulk, start: float, family: MaterialFamily) -> Foam:
    """The material that has the bulk modulus with which it was computed (fixed point; it contracts fast)."""
    bulk = start / (3.0 * (1.0 - 2.0 * family.poisson))
    for _ in range(200):
        material = of_bulk(bulk)
        if abs(material.bulk / bulk - 1.0) < 1e-12:
            break
        bulk = material.bulk
    return material
