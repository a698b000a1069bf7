"""Numbers that the element kernels need: material constants at a step, memory layout, critical time step."""

from __future__ import annotations

import math
from enum import Enum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from zsdt.scene import Foam
from zsdt.solid import stepping
from zsdt.solid.kernel_parts import FULL_MEMORY, LANES, STABILISED_MEMORY, TILE
from zsdt.solid.mesh import BrickMesh


class Element(Enum):
    """Hexahedron: one point with assumed-strain stabilisation, or 8 Gauss points (locks; for verification)."""

    stabilised = "stabilised"
    full = "full"


class Constants(NamedTuple):
    """Arguments of the kernels, in their order (see `codegen`)."""

    ih: float
    bulk: float
    m_inf: float
    m_vis: float
    keep: float
    cond_s: float
    cond_q: float
    m_last: float
    per_q: float
    lo: float
    hi: float


def constants_of(material: Foam, edge: float, m_inf: float, m_vis: float = 0.0, keep: float = 0.0) -> Constants:
    """Constants for a deviatoric modulus `m_inf` (2 mu) [Pa] beside a memory that gains `m_vis` dev E per step.

    The stability watch is off; see `watched`.
    """
    both = m_inf + m_vis
    uniaxial = material.bulk + 2.0 * both / 3.0
    return Constants(
        ih=1.0 / (4.0 * edge),
        bulk=material.bulk,
        m_inf=m_inf,
        m_vis=m_vis,
        keep=keep,
        cond_s=(material.bulk - both / 3.0) / uniaxial,
        cond_q=1.0 / uniaxial,
        m_last=(1.0 + material.poisson) / 9.0,
        per_q=0.0,
        lo=1e3,
        hi=1e3,
    )


def elastic_constants(material: Foam, edge: float) -> Constants:
    """Constants of a deformation that comes at once."""
    return constants_of(material, edge, 2.0 * material.shear)


def relaxed_constants(material: Foam, edge: float) -> Constants:
    """Constants of a deformation that was there for long."""
    return constants_of(material, edge, 2.0 * material.shear * (1.0 - material.g1))


def viscous_constants(material: Foam, edge: float, dt: float) -> Constants:
    """Constants of a time step `dt` [s]; elastic where the material has no Prony term."""
    if material.g1 == 0:
        return elastic_constants(material, edge)
    a = dt / material.tau
    keep = math.exp(-a)
    m_vis = 2.0 * material.shear * material.g1 * (1.0 - keep) / a
    constants = constants_of(material, edge, 2.0 * material.shear * (1.0 - material.g1), m_vis, keep)
    return constants._replace(per_q=1.0 / (4.0 * material.shear * material.g1))


def output_constants(step: Constants) -> Constants:
    """Constants that take the memory as a step with `step` left it."""
    m_inf = step.m_inf
    uniaxial = step.bulk + 2.0 * m_inf / 3.0
    return step._replace(m_vis=0.0, keep=1.0, cond_s=(step.bulk - m_inf / 3.0) / uniaxial, cond_q=1.0 / uniaxial)


def watched(constants: Constants, min_stretch: float, max_stretch: float) -> Constants:
    """Constants with limits on the principal stretches that the kernels watch."""
    return constants._replace(lo=(1.0 - min_stretch**2) / 2.0, hi=(max_stretch**2 - 1.0) / 2.0)


class Layout:
    """Arrays and strides of a mesh as the compiled loops want them."""

    def __init__(self, mesh: BrickMesh, element: Element):
        nx, ny, nz = mesh.counts
        tiles = math.ceil((nx + 1) * ny / LANES)
        self.mesh, self.full = mesh, element is Element.full
        self.stride = mesh.nodes + tiles * LANES + stepping.PADDING + nx + 2
        self.rows = FULL_MEMORY if self.full else STABILISED_MEMORY
        self.grid = (nx + 1, ny, nz, (nx + 1) * (ny + 1), self.stride, tiles, self.rows)
        number = np.arange(tiles * LANES)
        real = (number % (nx + 1) < nx) & (number < (nx + 1) * ny)
        self.weight = np.where(real, mesh.edge**2 / 4.0, 0.0)
        self.tile = np.zeros(TILE)

    def memory(self) -> Float[np.ndarray, " flat"]:
        """Memory rows of all tiles, zero."""
        return np.zeros(self.grid[2] * self.grid[5] * self.rows * LANES)

    def flat(self, values: Float[np.ndarray, "nodes components"]) -> Float[np.ndarray, " flat"]:
        """Nodal values as one padded block per component."""
        padded = np.zeros((values.shape[1], self.stride))
        padded[:, : self.mesh.nodes] = values.T
        return padded.ravel()

    def nodal(self, flat: Float[np.ndarray, " flat"]) -> Float[np.ndarray, "nodes components"]:
        """Nodal values of a flat array."""
        return np.ascontiguousarray(flat.reshape(-1, self.stride)[:, : self.mesh.nodes].T)

    def forces(self, u, f, memory, constants: Constants) -> int:
        """Internal forces at `u` into `f`; the memory goes one step on. Elements outside the watched range."""
        return stepping.internal_forces(
            self.full, True, self.grid, u, f, memory, self.weight, tuple(constants), self.tile
        )


def internal_force(
    mesh: BrickMesh, constants: Constants, element: Element, displacement: Float[np.ndarray, "nodes 3"]
) -> Float[np.ndarray, "nodes 3"]:
    """Internal forces [N] at a displacement [m] of a mesh without memory of anything earlier."""
    layout = Layout(mesh, element)
    f = np.zeros(3 * layout.stride)
    layout.forces(layout.flat(displacement), f, layout.memory(), constants)
    return layout.nodal(f)


@lru_cache(maxsize=64)
def critical_step(bulk: float, shear: float, poisson: float, density: float, element: Element) -> float:
    """Largest stable central-difference step [s] of an undeformed element of 1 m; it grows with the edge.

    From the highest frequency of one free element with moduli `bulk` and `shear` [Pa], which bounds that of
    every mesh of such elements. poisson: the value that the kernels take for the last hourglass mode.
    """
    mesh, small = BrickMesh((1, 1, 1), 1.0), 1e-6
    young = 9.0 * bulk * shear / (3.0 * bulk + shear)
    card = Foam(density=density, young=young, poisson=(3.0 * bulk - 2.0 * shear) / (6.0 * bulk + 2.0 * shear), g1=0.0)
    constants = elastic_constants(card, 1.0)._replace(m_last=(1.0 + poisson) / 9.0)
    columns = []
    for dof in range(24):
        unit = np.zeros((8, 3))
        unit.ravel()[dof] = small
        force = internal_force(mesh, constants, element, unit) - internal_force(mesh, constants, element, -unit)
        columns.append(force.ravel() / (2.0 * small))
    stiffness = np.array(columns)
    highest = np.linalg.eigvalsh(0.5 * (stiffness + stiffness.T))[-1] / (density / 8.0)
    return 2.0 / math.sqrt(highest)
