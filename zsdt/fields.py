"""State layout: the named fields, their tensor rank, SI unit, and the physical scale that goes with them.

Scales are physical and per field, never per component (DESIGN 4.2), so that a rotated or a softer beam stays in
the range that a network was trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Field:
    """One field of the state: `name`, number of `components`, SI `unit`, and a line that says what it is."""

    name: str
    components: int
    unit: str
    description: str


POSITION = Field("position", 3, "m", "current position of a node")
VELOCITY = Field("velocity", 3, "m/s", "velocity of a node")
STRESS = Field("stress", 6, "Pa", "Cauchy stress in the order 11 22 33 12 13 23")
ELASTIC_ENERGY = Field("elastic_energy", 1, "J/m3", "stored elastic energy per reference volume")
DISSIPATED_ENERGY = Field("dissipated_energy", 1, "J/m3", "energy turned into heat per reference volume")
INTERNAL_ENERGY = Field("internal_energy", 1, "J/kg", "specific internal energy: heat and compression")
DENSITY = Field("density", 1, "kg/m3", "density of a particle")
PRESSURE = Field("pressure", 1, "Pa", "pressure of a particle above that of the air")
LOAD = Field("load", 3, "N", "external force on a node without gravity")

_SOLID = (POSITION, VELOCITY, STRESS, ELASTIC_ENERGY, DISSIPATED_ENERGY, LOAD)
FIELDS = {f.name: f for f in (*_SOLID, INTERNAL_ENERGY, DENSITY, PRESSURE)}

STRESS_COMPONENTS = ("11", "22", "33", "12", "13", "23")
# Weights that turn a sum over six components into the double contraction s:s of the symmetric tensor.
VOIGT_WEIGHTS = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


def von_mises(stress: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch"]:
    """Von Mises equivalent [Pa] of Cauchy stress [Pa] in the order 11 22 33 12 13 23."""
    s11, s22, s33, s12, s13, s23 = np.moveaxis(stress, -1, 0)
    normal = (s11 - s22) ** 2 + (s22 - s33) ** 2 + (s33 - s11) ** 2
    return np.sqrt(0.5 * normal + 3.0 * (s12**2 + s13**2 + s23**2))
