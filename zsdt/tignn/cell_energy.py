"""Stored energy of one grid cell: what the sub-step form of the graph network learns (DESIGN 4.2).

A cell is a cube of eight nodes. Its 24 displacements give 18 strain measures that no rigid motion changes: six of
Green's strain at the centre and twelve amplitudes of the bilinear and trilinear modes, pulled back by F'. In an
orthonormal basis they fall into eight groups that the symmetries of the cube keep apart:

    volume, dev_normal, dev_shear      (centre)
    bend_even, bend_odd                (strain that varies linearly across the cell, two signs of the pair)
    twist_even, twist_odd, warp        (shear that varies linearly; the trilinear mode)

The stored energy density is `sum_k c_k p_k M_k(x) + sum_k v_k p_k(d)`: `p_k` the squared amplitude of a group, `c_k`
relaxed and `v_k` viscous moduli built from a few learned constants, `M_k` multipliers from a small network of the
invariants (1 where it is switched off), `d` the part of the strain that the memory still holds (one Prony term).
This module is the torch reference; `cell_kernel` is the same in numba and a test holds them together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import nn

from zsdt.trajectory import Body

GROUPS = ("volume", "dev_normal", "dev_shear", "bend_even", "bend_odd", "twist_even", "twist_odd", "warp")
STRAINS = 18
CONSTANTS = (
    "log_bulk",
    "log_shear",
    "logit_g1",
    "log_tau",
    *(f"log_{g}" for g in GROUPS[3:]),
    *(f"log_viscous_{g}" for g in GROUPS[3:]),
    "share_inertia",
)
FLAGS = ("clamped", "surface")

_CORNERS = np.array([(a, b, c) for c in (-1, 1) for b in (-1, 1) for a in (-1, 1)], float)
_X, _Y, _Z = _CORNERS.T
# Rows x, y, z, yz, xz, xy, xyz: the Hadamard patterns of a cell's corners.
PATTERNS = np.stack([_X, _Y, _Z, _Y * _Z, _X * _Z, _X * _Y, _X * _Y * _Z])


class CellStart(Enum):
    """How a rollout begins although the coarse model is not at rest in the given first frame."""

    residual = "residual"  # keep the given positions; a constant force per node balances frame 0
    shift = "shift"  # start in the model's own equilibrium; report displacements from there on the given frame
    plain = "plain"  # take the first frame as it is (a body in motion)


@dataclass
class CellOptions:
    """Options of the sub-step form.

    substeps per frame (0: from the stability limit times `safety`). memory: the Prony term. inertia: see
    `inertial_mass` (else lumped). correction: the network that multiplies the group energies by factors in
    `1 +- correction_range`, with `hidden` units. boundary: moduli of cells at the clamp and at the surface get factors
    of their own. readout: learned local correction of the nodal
    stress. start: see `CellStart`. anchor_stress: the difference between the first frame's stress and the model's is
    carried along with the deforming body. start_*: where the learning of the constants begins, deliberately off.
    fit_*: Levenberg-Marquardt on rollouts (iterations, beams per regime, first frames, every n-th of them).
    """

    substeps: int = 0
    safety: float = 0.9
    memory: bool = True
    inertia: bool = True
    correction: bool = False
    hidden: int = 6
    correction_range: float = 0.5
    boundary: bool = True
    readout: bool = True
    start: CellStart = CellStart.shift
    anchor_stress: bool = True
    start_young: float = 5.4e4
    start_poisson: float = 0.2
    start_g1: float = 0.3
    start_tau: float = 0.08
    start_weight: float = 0.6
    fit_iterations: int = 4
    fit_beams: int = 6
    fit_frames: int = 70
    fit_every: int = 4


_MAPS: dict[str, Callable[[float], float]] = {
    "log": np.exp,
    "logit": lambda x: 1 / (1 + np.exp(-x)),
    "share": lambda x: 0.25 / (1 + np.exp(-4 * x)),
}


@dataclass
class CellConstants:
    """The learned constants: `theta` in the order of `CONSTANTS`, and `boundary` [groups, flags], log factors.

    `card` is the material (K Pa, mu Pa, g1, tau s) of the bodies they were learned on; for another material the moduli
    are scaled by the ratio of the cards (zero-shot for other foams).
    """

    theta: Float[np.ndarray, " constants"]
    boundary: Float[np.ndarray, "groups flags"] = field(default_factory=lambda: np.zeros((len(GROUPS), len(FLAGS))))
    card: tuple[float, float, float, float] | None = None

    def named(self) -> dict[str, float]:
        """The constants in units a person reads: bulk, shear [Pa], g1, tau [s], weights of the mode groups,
        and the share of a surface layer's mass that moves as if it belonged to the next layer (inertia)."""
        out: dict[str, float] = {}
        for name, value in zip(CONSTANTS, self.theta, strict=True):
            kind, _, rest = name.partition("_")
            out[rest] = float(_MAPS[kind](value))
        return out


def start_constants(options: CellOptions) -> CellConstants:
    """Constants before any learning, from the `start_*` options."""
    young, poisson, g1 = options.start_young, options.start_poisson, options.start_g1
    bulk, shear = young / (3 * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    weights = np.full(10, np.log(options.start_weight))
    head = [np.log(bulk), np.log(shear), np.log(g1 / (1 - g1)), np.log(options.start_tau)]
    return CellConstants(theta=np.concatenate([head, weights, [-0.6]]))


def nominal_constants(bulk: float, shear: float, g1: float, tau: float) -> CellConstants:
    """Constants of a plain assumed-strain element of a known material: weights 1, lumped mass (Pa, Pa, -, s)."""
    head = [np.log(bulk), np.log(shear), np.log(g1 / (1 - g1)), np.log(tau)]
    return CellConstants(theta=np.concatenate([head, np.zeros(10), [-3.0]]))


def card_of(body: Body) -> tuple[float, float, float, float] | None:
    """Material card (K [Pa], instantaneous mu [Pa], g1, tau [s]) of a body, None where it is unknown."""
    m = body.material
    return None if m is None else (m.bulk, m.shear, m.g1, m.tau)


@dataclass(frozen=True)
class Moduli:
    """Group moduli of the cells of one body: relaxed and viscous [groups, cells] Pa, relaxation time tau [s]."""

    relaxed: Float[np.ndarray, "groups cells"]
    viscous: Float[np.ndarray, "groups cells"]
    tau: float


def moduli_of(
    constants: CellConstants,
    flags: Float[np.ndarray, "cells flags"],
    card: tuple[float, float, float, float] | None = None,
    memory: bool = True,
) -> Moduli:
    """Group moduli from the learned constants; `card` is the material of the body at hand.

    An assumed-strain element (plane stress across the bending direction, parasitic shear left out) has weight 1.
    """
    value = constants.named()
    bulk, shear, g1, tau = (value[k] for k in ("bulk", "shear", "g1", "tau"))
    if card is not None and constants.card is not None:
        bulk, shear = bulk * card[0] / constants.card[0], shear * card[1] / constants.card[1]
        odds = g1 / (1 - g1) * _odds(card[2]) / _odds(constants.card[2])
        g1, tau = odds / (1 + odds), tau * card[3] / constants.card[3]

    def groups(mu: float) -> np.ndarray:
        even = 3 * bulk * mu / (3 * bulk + 4 * mu)
        return np.array([0.5 * bulk, mu, mu, even, mu / 3, 2 * mu / 3, mu / 6, mu / 6])

    weight = np.concatenate([np.ones(3), [value[g] for g in GROUPS[3:]]])
    viscous_weight = np.concatenate([[0.0, 1.0, 1.0], [value[f"viscous_{g}"] for g in GROUPS[3:]]])
    relaxed = weight * groups((1 - g1) * shear)
    viscous = viscous_weight * (groups(shear) - groups((1 - g1) * shear)) * (1.0 if memory else 0.0)
    factor = np.exp(constants.boundary @ flags.T)
    return Moduli(
        relaxed=np.ascontiguousarray(relaxed[:, None] * factor),
        viscous=np.ascontiguousarray(viscous[:, None] * factor),
        tau=float(tau),
    )


def _odds(g1: float) -> float:
    return max(g1, 1e-9) / (1 - g1)


def free_faces(cells: Int[np.ndarray, "cells 8"], clamped: Bool[np.ndarray, " nodes"]) -> Bool[np.ndarray, "cells 6"]:
    """Which faces of a cell (low x, high x, low y, ...) have no neighbour and are not held."""
    faces = np.array([[n for n in range(8) if (n >> a) & 1 == side] for a in range(3) for side in (0, 1)])
    of_cells = np.sort(cells[:, faces], axis=2).reshape(-1, 4)
    _, which, count = np.unique(of_cells, axis=0, return_inverse=True, return_counts=True)
    lonely = (count[which.ravel()] == 1).reshape(-1, 6)
    return lonely & ~clamped[cells][:, faces].all(axis=2)


def cell_flags(cells: Int[np.ndarray, "cells 8"], clamped: Bool[np.ndarray, " nodes"]) -> Float[np.ndarray, "c f"]:
    """Where a cell sits: share of its corners that the clamp holds (x 2), and free faces (over 2) [cells, flags]."""
    free = free_faces(cells, clamped).sum(axis=1)
    return np.stack([2.0 * clamped[cells].mean(axis=1), 0.5 * free], axis=1)


def inertial_mass(body: Body, share: float) -> Float[np.ndarray, " nodes"]:
    """Masses [kg] that resist acceleration: `share` of what a cell gives to its corners on a free face goes to the
    corners opposite.

    Lumping puts too much mass on the surface, so bending vibrations of a coarse grid are slow (the trapezoidal rule; a
    share of 1/12 is Gregory's end correction). Total mass stays, and weight acts where it did.
    """
    faces = free_faces(body.cells, body.clamped)
    part = np.ones((len(body.cells), 8))
    for axis in range(3):
        own = faces[:, [2 * axis + (n >> axis & 1) for n in range(8)]]
        opposite = faces[:, [2 * axis + 1 - (n >> axis & 1) for n in range(8)]]
        part *= 1 + 2 * share * (opposite.astype(float) - own)
    density = body.mass.sum() / (8 * len(body.cells))
    return np.bincount(body.cells.ravel(), (density * part).ravel(), minlength=body.nodes)


# --- torch reference -------------------------------------------------------------------------------------------------


def cell_strain(u: Float[torch.Tensor, "cells 8 3"], pitch: float) -> Float[torch.Tensor, "cells 18"]:
    """Strain measures of cells from the displacements [m] of their corners (orthonormal basis, see the module)."""
    patterns = torch.as_tensor(PATTERNS / (4 * pitch), dtype=u.dtype)
    modes = torch.einsum("an,cni->cai", patterns, u)
    gradient = modes[:, :3].transpose(1, 2)
    deformation = gradient + torch.eye(3, dtype=u.dtype)
    green = 0.5 * (deformation.transpose(1, 2) @ deformation - torch.eye(3, dtype=u.dtype))
    pulled = modes[:, 3:] @ deformation
    yz, xz, xy, xyz = pulled[:, 0], pulled[:, 1], pulled[:, 2], pulled[:, 3]
    pairs = ((xy[:, 0], yz[:, 2]), (xy[:, 1], xz[:, 2]), (xz[:, 0], yz[:, 1]))
    twist = (yz[:, 0], xz[:, 1], xy[:, 2])
    return torch.stack(
        [
            *(green[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))),
            *((a + b) / 2**0.5 for a, b in pairs),
            *((a - b) / 2**0.5 for a, b in pairs),
            (twist[0] + twist[1] + twist[2]) / 3**0.5,
            (twist[0] - twist[1]) / 2**0.5,
            (twist[0] + twist[1] - 2 * twist[2]) / 6**0.5,
            *xyz.unbind(1),
        ],
        dim=1,
    )


def group_squares(strain: Float[torch.Tensor, "cells 18"]) -> Float[torch.Tensor, "cells 8"]:
    """Squared amplitude of each group; the first is the squared trace."""
    e = strain
    trace = e[:, 0] + e[:, 1] + e[:, 2]
    normal = ((e[:, :3] - trace[:, None] / 3) ** 2).sum(1)
    sums = [(e[:, a:b] ** 2).sum(1) for a, b in ((6, 9), (9, 12), (12, 13), (13, 15), (15, 18))]
    return torch.stack([trace**2, normal, 2 * (e[:, 3:6] ** 2).sum(1), *sums], dim=1)


def soft_sign(x: Float[torch.Tensor, "*s"]) -> Float[torch.Tensor, "*s"]:
    """x / sqrt(1 + x^2): bounded, smooth, and without exponentials."""
    return x * torch.rsqrt(1 + x * x)


class EnergyCorrection(nn.Module):
    """Small network: invariants and flags of a cell -> multipliers of its eight group energies.

    Multipliers stay in `1 +- reach`, so the energy is positive and zero at rest whatever the weights are. Fresh
    weights give exactly 1.
    """

    SCALE = 0.1

    def __init__(self, hidden: int, reach: float, generator: torch.Generator | None = None):
        super().__init__()
        inputs = len(GROUPS) + len(FLAGS)
        self.reach = reach
        self.inner = nn.Parameter(torch.randn(hidden, inputs, generator=generator, dtype=torch.float64) / inputs**0.5)
        self.inner_bias = nn.Parameter(0.1 * torch.randn(hidden, generator=generator, dtype=torch.float64))
        self.outer = nn.Parameter(torch.zeros(len(GROUPS), hidden, dtype=torch.float64))
        self.outer_bias = nn.Parameter(torch.zeros(len(GROUPS), dtype=torch.float64))

    def forward(
        self, trace: Float[torch.Tensor, " cells"], squares: Float[torch.Tensor, "cells 8"], flags: torch.Tensor
    ) -> Float[torch.Tensor, "cells 8"]:
        """Multipliers [cells, groups] from trace of Green's strain, `group_squares` and `cell_flags`."""
        s = self.SCALE
        bounded = squares[:, 1:] / (s * s + squares[:, 1:])
        x = torch.cat([soft_sign(trace / s)[:, None], bounded, flags], dim=1)
        inner = soft_sign(x @ self.inner.T + self.inner_bias)
        return 1 + self.reach * soft_sign(inner @ self.outer.T + self.outer_bias)


def stored_energy(
    u: Float[torch.Tensor, "cells 8 3"],
    pitch: float,
    relaxed: Float[torch.Tensor, "8 cells"],
    viscous: Float[torch.Tensor, "8 cells"],
    viscous_strain: Float[torch.Tensor, "cells 18"] | None = None,
    correction: EnergyCorrection | None = None,
    flags: Float[torch.Tensor, "cells f"] | None = None,
) -> Float[torch.Tensor, " cells"]:
    """Stored energy [J] of each cell; forces are minus its gradient, and memory relaxes down its slope.

    u [cells, 8, 3] m: displacements of the corners. relaxed, viscous: `Moduli`. viscous_strain: what the dashpots
    have yielded so far (None: everything, so that only the relaxed energy is left).
    """
    strain = cell_strain(u, pitch)
    squares = group_squares(strain)
    density = relaxed.T * squares
    if correction is not None:
        assert flags is not None
        density = density * correction(strain[:, :3].sum(1), squares, flags)
    total = density.sum(1)
    if viscous_strain is not None:
        total = total + (viscous.T * group_squares(strain - viscous_strain)).sum(1)
    return total * pitch**3


def generic_rates(
    u: Float[torch.Tensor, "cells 8 3"],
    viscous_strain: Float[torch.Tensor, "cells 18"],
    pitch: float,
    moduli: Moduli,
    correction: EnergyCorrection | None = None,
    flags: Float[torch.Tensor, "cells f"] | None = None,
) -> dict[str, torch.Tensor]:
    """The metriplectic pieces of each cell: gradients of energy and entropy, and the two brackets (seed, Eq. 3).

    Thermodynamic state of a cell: viscous strain b [18] and heat w [J]. Energy gradient `(dW/db, 1)`, entropy gradient
    `(0, 1/T0)` with T0 = 1. Friction `M = T0 (I; Y') A (I, Y)` with `Y = -dW/db` and `A = C^-1 / tau` on what Y spans,
    so `M dE = 0` by projection and `M dS = (b', Y b')`. `strain_force = -dW/du` is what the canonical L carries.
    """
    u = u.detach().requires_grad_(True)
    b = viscous_strain.detach().requires_grad_(True)
    relaxed, viscous = torch.as_tensor(moduli.relaxed), torch.as_tensor(moduli.viscous)
    energy = stored_energy(u, pitch, relaxed, viscous, b, correction, flags).sum()
    force_u, slope = torch.autograd.grad(energy, (u, b))
    yields = -slope
    compliance = _viscous_compliance(viscous, pitch) / moduli.tau
    lift = torch.cat([torch.eye(STRAINS, dtype=u.dtype).expand(len(b), -1, -1), yields[:, None, :]], dim=1)
    friction = lift @ compliance @ lift.transpose(1, 2)
    one = torch.ones(len(b), 1, dtype=u.dtype)
    return {
        "energy_gradient": torch.cat([slope, one], dim=1),
        "entropy_gradient": torch.cat([torch.zeros_like(slope), one], dim=1),
        "friction": friction,
        "strain_force": -force_u,
    }


def _viscous_compliance(viscous: Float[torch.Tensor, "8 cells"], pitch: float) -> Float[torch.Tensor, "cells 18 18"]:
    """Pseudo-inverse of the second derivative of the viscous energy [cells, 18, 18]; zero on the trace."""
    group = torch.tensor([1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5, 6, 6, 7, 7, 7])
    stiff = 2 * viscous.T[:, group] * pitch**3
    stiff[:, 3:6] *= 2
    inverse = torch.where(stiff > 0, 1 / stiff.clamp_min(1e-300), torch.zeros_like(stiff))
    deviator = torch.eye(STRAINS, dtype=viscous.dtype)
    deviator[:3, :3] -= 1 / 3
    return deviator @ torch.diag_embed(inverse) @ deviator
