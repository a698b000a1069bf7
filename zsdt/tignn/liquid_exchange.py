"""Impulses along edges and from the wall that give particles the increments that a network wants.

A decoder may want any increment for any particle; between particles momentum can only be exchanged. The exchange
nearest to what is wanted is the one of a network of springs: potentials y [nodes, 3] with

    (sum w u u' (e_i - e_j)(e_i - e_j)' + walls w n n' + small) y = wanted impulses,

then a pair takes `w u.(y_i - y_j)` along its arm u and the wall gives `-w n.y` along its normal (no edge, no impulse;
equal and opposite on both sides, so momentum and angular momentum between particles are conserved whatever the
network says). One sparse solve spans the whole liquid, as the pressure of a nearly incompressible liquid does: sound
crosses the glass within a frame, and no number of passes balances weight as exactly.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float, Int

_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True)

TOLERANCE = 1e-4
MOST_ITERATIONS = 200
SMALL = 1e-4  # stiffness to the ground over the mean one of the springs: what a free drop rests on


@_jit
@no_type_check
def _multiply(pairs, arms, weights, walls, ground, x, out, n0, n1, p0, p1):
    """out = (springs + walls + ground) x over the nodes n0 ... n1 and pairs p0 ... p1 of one body."""
    for i in range(n0, n1):
        along = 0.0
        for d in range(3):
            along += walls[i, d] * x[i, d]
        for d in range(3):
            out[i, d] = along * walls[i, d] + ground[i] * x[i, d]
    for k in range(p0, p1):
        i, j = pairs[k, 0], pairs[k, 1]
        along = 0.0
        for d in range(3):
            along += arms[k, d] * (x[i, d] - x[j, d])
        along *= weights[k]
        for d in range(3):
            out[i, d] += along * arms[k, d]
            out[j, d] -= along * arms[k, d]


@_jit
@no_type_check
def _prepare(pairs, arms, weights, walls, mass, small, diagonal, ground, n0, n1, p0, p1):
    """Diagonal of the matrix and stiffness to the ground of the nodes of one body.

    The ground holds in proportion to mass, so that a drop that falls freely is not deformed by it.
    """
    for i in range(n0, n1):
        for d in range(3):
            diagonal[i, d] = walls[i, d] ** 2
    for k in range(p0, p1):
        for d in range(3):
            share = weights[k] * arms[k, d] ** 2
            diagonal[pairs[k, 0], d] += share
            diagonal[pairs[k, 1], d] += share
    mean = 0.0
    for i in range(n0, n1):
        mean += (diagonal[i, 0] + diagonal[i, 1] + diagonal[i, 2]) / (3.0 * (n1 - n0))
    for i in range(n0, n1):
        ground[i] = (small * mean + 1e-9) * max(mass[i], 1e-3)
        for d in range(3):
            diagonal[i, d] += ground[i]


@_jit
@no_type_check
def _solve(pairs, arms, weights, walls, mass, right, starts, pair_starts, y, tolerance, most, small):
    """Conjugate gradients with Jacobi preconditioner, body by body so that none depends on its batch.

    arms [pairs, 3]: unit vectors; weights [pairs]; walls [nodes, 3]: normal times root of the weight; mass [nodes]:
    0 for what cannot move, whose potential stays 0.
    """
    nodes = right.shape[0]
    diagonal, ground = np.empty((nodes, 3)), np.empty(nodes)
    residual, direction, product = np.zeros((nodes, 3)), np.zeros((nodes, 3)), np.zeros((nodes, 3))
    y[:] = 0.0
    for body in range(starts.size - 1):
        n0, n1, p0, p1 = starts[body], starts[body + 1], pair_starts[body], pair_starts[body + 1]
        _prepare(pairs, arms, weights, walls, mass, small, diagonal, ground, n0, n1, p0, p1)
        norm = 0.0
        for i in range(n0, n1):
            for d in range(3):
                residual[i, d] = right[i, d] if mass[i] > 0 else 0.0
                direction[i, d] = residual[i, d] / diagonal[i, d]
                norm += residual[i, d] * direction[i, d]
        first = norm
        for _ in range(most):
            if not norm > tolerance * tolerance * first:
                break
            _multiply(pairs, arms, weights, walls, ground, direction, product, n0, n1, p0, p1)
            curvature, new = 0.0, 0.0
            for i in range(n0, n1):
                for d in range(3):
                    curvature += direction[i, d] * product[i, d]
            step = norm / curvature
            for i in range(n0, n1):
                if mass[i] > 0:
                    for d in range(3):
                        y[i, d] += step * direction[i, d]
                        residual[i, d] -= step * product[i, d]
                        new += residual[i, d] ** 2 / diagonal[i, d]
            for i in range(n0, n1):
                for d in range(3):
                    direction[i, d] = residual[i, d] / diagonal[i, d] + new / norm * direction[i, d]
            norm = new


class Springs:
    """The network of springs of one moment, of one body or of several.

    pairs [pairs, 2] sorted by their first node; arms [pairs, 3]: unit vectors from the second to the first; weights
    [pairs, 1]; walls [nodes, 3]: normal times the root of its weight; mass [nodes, 1]: 0 for what cannot move.
    """

    def __init__(
        self,
        pairs: Int[np.ndarray, "pairs 2"],
        arms: Float[torch.Tensor, "pairs 3"],
        weights: Float[torch.Tensor, "pairs 1"],
        walls: Float[torch.Tensor, "nodes 3"],
        mass: Float[torch.Tensor, "nodes 1"],
        member: Int[np.ndarray, " nodes"],
    ):
        starts = np.searchsorted(member, np.arange(int(member[-1]) + 2))
        parts = (arms, weights[:, 0], walls, mass[:, 0])
        self.fixed = (pairs, *(np.ascontiguousarray(t.detach().double().numpy()) for t in parts))
        self.bounds = (starts, np.searchsorted(pairs[:, 0], starts))

    def potentials(self, right: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3"]:
        """Solves for the potentials of wanted impulses."""
        y = np.empty_like(right)
        _solve(*self.fixed, right, *self.bounds, y, TOLERANCE, MOST_ITERATIONS, SMALL)
        return y


class _Exchange(torch.autograd.Function):
    """Autograd node: the matrix is symmetric, so the gradient is one more solve."""

    @staticmethod
    def forward(ctx: Any, wanted, springs):
        ctx.springs = springs
        return torch.from_numpy(springs.potentials(wanted.detach().double().numpy())).to(wanted.dtype)

    @staticmethod
    def backward(ctx: Any, *upstream):
        g = np.ascontiguousarray(upstream[0].double().numpy())
        return torch.from_numpy(ctx.springs.potentials(g)).to(upstream[0].dtype), None


def exchange_potentials(wanted: Float[torch.Tensor, "nodes 3"], springs: Springs) -> Float[torch.Tensor, "nodes 3"]:
    """Potentials y of the impulses nearest to `wanted`; differentiable in `wanted`."""
    return _Exchange.apply(wanted, springs)
