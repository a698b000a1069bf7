"""The GENERIC update of the nodes: exact two-node brackets, the seed's soft matrices, or a plain decoder.

All act in the scaled coordinates y of the state (increments over their scales); gradients e = dE/dy, s = dS/dy are
those of the same coordinates, so degeneracy in y is degeneracy in SI.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import nn
from torch.nn import functional

from zsdt.tignn.features import EDGE_FEATURES, GraphBatch
from zsdt.tignn.message_passing import Perceptron
from zsdt.tignn.options import Bracket, Energy, TignnOptions
from zsdt.tignn.wiring import Wiring


@dataclass
class Rates:
    """What a bracket gives for each node in scaled coordinates, [nodes, d] each, and the soft penalty (scalar).

    reversible: L dE, irreversible: M dS, port: external work. energy, entropy: the gradients (None for `none`).
    ldS, mdE: what should vanish. penalty: |M dE|2 + |L dS|2 of the bulk (soft only).
    """

    reversible: torch.Tensor
    irreversible: torch.Tensor
    port: torch.Tensor
    energy: torch.Tensor | None = None
    entropy: torch.Tensor | None = None
    ldS: torch.Tensor | None = None
    mdE: torch.Tensor | None = None
    penalty: torch.Tensor | None = None

    @property
    def total(self) -> torch.Tensor:
        """Increment of the state in scaled coordinates."""
        return self.reversible + self.irreversible + self.port


class Gradients(nn.Module):
    """Decoded dE/dy and dS/dy per node (energy=learned)."""

    def __init__(self, width: int, d: int, hidden: int):
        super().__init__()
        self.both = Perceptron(width, width, 2 * d, hidden)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        energy, entropy = self.both(x).chunk(2, dim=1)
        return energy, entropy


class Ports(nn.Module):
    """Where external work enters: linear in the load on a node and in gravity, with decoded responses."""

    def __init__(self, width: int, d: int, hidden: int):
        super().__init__()
        self.response = Perceptron(width, width, 6 * d, hidden, gain=0.3)

    def forward(
        self, x: Float[torch.Tensor, "nodes width"], push: Float[torch.Tensor, "nodes 6"]
    ) -> Float[torch.Tensor, "nodes d"]:
        """`push`: load and gravity of each node over their scales; no push, no work."""
        return (self.response(x).view(x.shape[0], -1, 6) * push[:, None]).sum(-1)


class EdgeDecoder(nn.Module):
    """Decodes `outputs` numbers for each directed edge from the latents of both ends and the edge features."""

    def __init__(self, width: int, outputs: int, gain: float, edge_features: int = EDGE_FEATURES):
        super().__init__()
        half = max(width // 2, 1)
        self.receiver, self.sender = nn.Linear(width, half), nn.Linear(width, half, bias=False)
        self.edge = nn.Linear(edge_features, half, bias=False)
        self.last = nn.Linear(half, outputs)
        with torch.no_grad():
            self.last.weight.mul_(gain)
            self.last.bias.mul_(gain)

    def forward(self, batch: Wiring, x: torch.Tensor, edge: torch.Tensor) -> torch.Tensor:
        hidden = self.receiver(x).index_select(0, batch.to) + self.sender(x).index_select(0, batch.source)
        hidden = hidden + self.edge(edge)
        return self.last(functional.silu(hidden))


class ExactBracket(nn.Module):
    """Sum of projected two-node brackets and the one-node bulk; degenerate by construction."""

    def __init__(self, options: TignnOptions, d: int):
        super().__init__()
        self.rank, self.d = options.rank, d
        self.edges = EdgeDecoder(options.width, 3 * self.rank * d, gain=0.5)
        self.nodes = Perceptron(options.width, options.width, 3 * self.rank * d, options.hidden_layers)
        learned = options.energy is Energy.learned
        self.gradients = Gradients(options.width, d, options.hidden_layers) if learned else None
        self.ports = Ports(options.width, d, options.hidden_layers) if learned else None

    def forward(
        self,
        batch: GraphBatch,
        x: Float[torch.Tensor, "nodes width"],
        edge: Float[torch.Tensor, "directed features"],
        mask: Float[torch.Tensor, "nodes d"],
        push: Float[torch.Tensor, "nodes 6"],
        given: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None,
    ) -> Rates:
        """`mask` is 0 where a component of a node is held; `given` are e, s and port where they are known."""
        if self.gradients is not None and self.ports is not None:
            energy, entropy = self.gradients(x)
            port = self.ports(x, push) * mask
        else:
            assert given is not None
            energy, entropy, port = given
        energy, entropy = energy * mask, entropy * mask
        shape = (3, self.rank, self.d)
        # Where a component is held its gradients are zero, so leaving its rate out costs no energy and no entropy.
        pairs = self.edges(batch, x, edge).view(-1, *shape)
        reversible, irreversible = batch.brackets(pairs, self.nodes(x).view(-1, *shape), energy, entropy)
        return Rates(reversible * mask, irreversible * mask, port, energy, entropy)


class SoftBracket(nn.Module):
    """The seed's Eq. 3: bulk L_i, M_i act on the gradients of the node, L_ij, M_ij on those of its neighbours."""

    def __init__(self, options: TignnOptions, d: int):
        super().__init__()
        self.d = d
        self.lower = torch.tril_indices(d, d, -1)
        self.full = torch.tril_indices(d, d)
        count = self.lower.shape[1] + self.full.shape[1]
        self.edges = EdgeDecoder(options.width, count, gain=0.5)
        self.nodes = Perceptron(options.width, options.width, count, options.hidden_layers)
        self.gradients = Gradients(options.width, d, options.hidden_layers)
        self.ports = Ports(options.width, d, options.hidden_layers)

    def _matrices(self, decoded: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        lower, full = decoded.split([self.lower.shape[1], self.full.shape[1]], dim=1)
        skew = decoded.new_zeros(decoded.shape[0], self.d, self.d)
        root = torch.zeros_like(skew)
        skew[:, self.lower[0], self.lower[1]] = lower
        root[:, self.full[0], self.full[1]] = full
        return skew - skew.transpose(1, 2), root @ root.transpose(1, 2) / self.d

    def forward(self, batch, x, edge, mask, push, given=None) -> Rates:
        """As `ExactBracket.forward`; the gradients are always decoded."""
        energy, entropy = self.gradients(x)
        column_e, column_s = energy[..., None], entropy[..., None]
        poisson, friction = self._matrices(self.nodes(x))
        ldS, mdE = (poisson @ column_s)[..., 0], (friction @ column_e)[..., 0]
        bulk, heat = (poisson @ column_e)[..., 0], (friction @ column_s)[..., 0]
        poisson, friction = self._matrices(self.edges(batch, x, edge))
        flux = (poisson @ column_e.index_select(0, batch.source))[..., 0]
        heat_flux = (friction @ column_s.index_select(0, batch.source))[..., 0]
        reversible = bulk.index_add(0, batch.to, -flux) * mask
        irreversible = heat.index_add(0, batch.to, -heat_flux) * mask
        penalty = mdE.square().mean() + ldS.square().mean()
        port = self.ports(x, push) * mask
        return Rates(reversible, irreversible, port, energy * mask, entropy * mask, ldS, mdE, penalty)


class PlainDecoder(nn.Module):
    """No bracket: the black box (MeshGraphNet-like) that every report compares with."""

    def __init__(self, options: TignnOptions, d: int):
        super().__init__()
        self.decoder = Perceptron(options.width, options.width, d, options.hidden_layers)

    def forward(self, batch, x, edge, mask, push, given=None) -> Rates:
        """As `ExactBracket.forward`; all of the increment is booked as a port, since nothing is known about it."""
        zero = torch.zeros_like(mask)
        return Rates(zero, zero, self.decoder(x) * mask)


def make_bracket(options: TignnOptions, d: int) -> nn.Module:
    """The update head that `options.bracket` names, for a state of `d` components per node."""
    kinds = {Bracket.exact: ExactBracket, Bracket.soft: SoftBracket, Bracket.none: PlainDecoder}
    return kinds[options.bracket](options, d)
