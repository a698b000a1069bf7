"""The seed's network as its authors built it: the yardstick of every claim about speed (seed, Section III.A, Eq. 3).

Two hidden layers of 100, seven passes over concatenated latents, a mean over the neighbours, and for every directed
edge and self-loop two decoded d x d matrices, `L = l - l'` and `M = m m'`. In plain torch operations, nothing fused,
undirected or factorised. The seed gives 299k trainable parameters for its liquid (Section V.B): that count comes out
when the seven passes share their weights, and when the two matrix decoders are twice as deep as the rest, as in the
authors' published code (github.com/a-tierz/Local-ThermodynamicsGNN). `shared=False` gives every pass its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import nn

from zsdt.tignn.message_passing import Perceptron


@dataclass(frozen=True)
class SeedSizes:
    """Components per node of the state (12 for a solid: position, velocity, stress; 7 for a liquid: position,
    velocity, internal energy), and of the external force (3 for a solid, 0 for a liquid)."""

    state: int
    force: int = 0

    @property
    def node(self) -> int:
        """What the encoder of the nodes reads: all of the state but the position, and the kind of the node."""
        return self.state - 3 + 1

    @property
    def edge(self) -> int:
        """What the encoder of the edges reads: the difference of the positions and its length."""
        return 4


@dataclass(frozen=True)
class SeedRates:
    """Rates of the scaled state [nodes, d], and what the matrices did: reversible and irreversible parts, gradients
    of energy and entropy, and the bulk terms L dS and M dE that ought to vanish (all [nodes, d])."""

    reversible: torch.Tensor
    irreversible: torch.Tensor
    energy: torch.Tensor
    entropy: torch.Tensor
    ldS: torch.Tensor
    mdE: torch.Tensor

    @property
    def total(self) -> torch.Tensor:
        """Rate of the scaled state."""
        return self.reversible + self.irreversible

    @property
    def penalty(self) -> torch.Tensor:
        """`|M dE|2 + |L dS|2` of the bulk, as means (seed, Eq. 4 as a soft constraint)."""
        return self.mdE.square().mean() + self.ldS.square().mean()


class SeedPass(nn.Module):
    """One pass: edges from their latent and both ends, nodes from their latent, the mean of their edges, the force."""

    def __init__(self, width: int, hidden: int, force: int):
        super().__init__()
        self.edge = Perceptron(3 * width, width, width, hidden)
        self.node = Perceptron(2 * width + force, width, width, hidden)

    def forward(self, x, e, f, to, source, degree):
        """Latents of nodes and edges after the pass (both residual)."""
        message = self.edge(torch.cat([e, x[source], x[to]], dim=1))
        mean = torch.zeros_like(x).index_add(0, to, message) / degree
        return x + self.node(torch.cat([x, mean, *f], dim=1)), e + message


class SeedNetwork(nn.Module):
    """Encoder, passes and decoders of the seed."""

    def __init__(self, sizes: SeedSizes, width: int = 100, hidden: int = 2, passes: int = 7, shared: bool = True):
        super().__init__()
        self.sizes, self.depth = sizes, passes
        d, force = sizes.state, width // 2 if sizes.force else 0
        self.encode_node = Perceptron(sizes.node, width, width, hidden)
        self.encode_edge = Perceptron(sizes.edge, width, width, hidden)
        self.encode_force = Perceptron(sizes.force, width, force, hidden) if sizes.force else None
        self.passes = nn.ModuleList(SeedPass(width, hidden, force) for _ in range(1 if shared else passes))
        self.energy = Perceptron(width, width, d, hidden)
        self.entropy = Perceptron(width, width, d, hidden)
        self.poisson = Perceptron(3 * width, width, d * (d - 1) // 2, 2 * hidden)
        self.friction = Perceptron(3 * width, width, d * (d + 1) // 2, 2 * hidden)
        self.lower, self.full = torch.tril_indices(d, d, -1), torch.tril_indices(d, d)

    def operators(
        self, ends: Float[torch.Tensor, "edges three_width"]
    ) -> tuple[Float[torch.Tensor, "edges d d"], Float[torch.Tensor, "edges d d"]]:
        """L (skew) and M (symmetric, positive semi-definite) of every edge from its latent and those of its ends."""
        d = self.sizes.state
        lower, root = ends.new_zeros(len(ends), d, d), ends.new_zeros(len(ends), d, d)
        lower[:, self.lower[0], self.lower[1]] = torch.tanh(self.poisson(ends))
        root[:, self.full[0], self.full[1]] = torch.tanh(self.friction(ends))
        return lower - lower.transpose(1, 2), torch.bmm(root, root.transpose(1, 2))

    def latents(
        self,
        node: Float[torch.Tensor, "nodes features"],
        edge: Float[torch.Tensor, "directed 4"],
        force: Float[torch.Tensor, "nodes force"] | None,
        to: Int[torch.Tensor, " directed"],
        source: Int[torch.Tensor, " directed"],
    ) -> tuple[Float[torch.Tensor, "nodes width"], Float[torch.Tensor, "directed width"]]:
        """Latents of nodes and edges after all passes."""
        x, e = self.encode_node(node), self.encode_edge(edge)
        f = [self.encode_force(force)] if self.encode_force is not None else []
        degree = torch.bincount(to, minlength=len(x)).clamp_min(1).to(x.dtype)[:, None]
        for k in range(self.depth):
            x, e = self.passes[k % len(self.passes)](x, e, f, to, source, degree)
        return x, e

    def forward(self, node, edge, force, to, source) -> SeedRates:
        """Rates of all nodes: `L_i dE_i + M_i dS_i - sum_j (L_ij dE_j + M_ij dS_j)`, the bulk terms from self-loops
        whose latent is one."""
        x, e = self.latents(node, edge, force, to, source)
        energy, entropy = self.energy(x), self.entropy(x)
        skew, damping = self.operators(torch.cat([torch.ones_like(x), x, x], dim=1))
        reversible, irreversible = _apply(skew, energy), _apply(damping, entropy)
        ldS, mdE = _apply(skew, entropy), _apply(damping, energy)
        skew, damping = self.operators(torch.cat([e, x[source], x[to]], dim=1))
        reversible = reversible.index_add(0, to, _apply(skew, energy[source]), alpha=-1)
        irreversible = irreversible.index_add(0, to, _apply(damping, entropy[source]), alpha=-1)
        return SeedRates(reversible, irreversible, energy, entropy, ldS, mdE)


def _apply(matrices: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    return torch.bmm(matrices, vectors[..., None])[..., 0]
