"""Message passing and brackets in plain tensor operations, so that a network can be traced: compiled, or into ONNX.

The compiled loops of `zsdt.tignn.kernels` and `zsdt.tignn.bracket_kernels` are opaque to a tracer; here are the same
sums as gathers and scatters, with the wiring as tensors that may have any length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from zsdt.graph import graph_of
from zsdt.tignn.bracket_kernels import SMALLEST_SQUARE
from zsdt.tignn.features import GraphBatch
from zsdt.tignn.kernels import activation
from zsdt.tignn.liquid_features import LiquidBatch
from zsdt.tignn.wiring import Wiring

# The tensors below say who talks to whom; the numpy graph of the base class stays empty.
NO_GRAPH = graph_of(0, np.zeros((0, 2), np.int64))
NO_HALVES = np.zeros((0, 2), np.int64)


@dataclass(frozen=True)
class _Plain(Wiring):
    """One body. pairs [pairs, 2]: nodes of each pair; rows [pairs, 2]: where its halves lie in the directed list."""

    pairs: torch.Tensor
    rows: torch.Tensor

    def messages(
        self,
        sender: Float[torch.Tensor, "nodes width"],
        receiver: Float[torch.Tensor, "nodes width"],
        weight: Float[torch.Tensor, "features width"],
        edge: Float[torch.Tensor, "directed features"],
    ) -> Float[torch.Tensor, "nodes width"]:
        """See `Wiring.messages`."""
        layer = activation(receiver[self.to] + sender[self.source] + edge @ weight)
        return torch.zeros_like(receiver).index_add(0, self.to, layer)

    def brackets(
        self,
        edges: Float[torch.Tensor, "directed 3 rank d"],
        nodes: Float[torch.Tensor, "nodes 3 rank d"],
        energy: Float[torch.Tensor, "nodes d"],
        entropy: Float[torch.Tensor, "nodes d"],
    ) -> tuple[Float[torch.Tensor, "nodes d"], Float[torch.Tensor, "nodes d"]]:
        """See `Wiring.brackets`."""
        d = energy.shape[1]
        first, second = self.pairs[:, 0], self.pairs[:, 1]
        both = torch.cat([edges[self.rows[:, 0]], edges[self.rows[:, 1]]], dim=-1)
        e, s = (torch.cat([g[first], g[second]], dim=1) for g in (energy, entropy))
        bulk, friction = bracket(nodes, energy, entropy)
        found = []
        for own, flux in zip((bulk, friction), bracket(both, e, s), strict=True):
            found.append(own.index_add(0, first, flux[:, :d]).index_add(0, second, flux[:, d:]))
        return found[0], found[1]


@dataclass(frozen=True)
class PlainBatch(_Plain, GraphBatch):
    """A solid body (see `GraphBatch`) whose wiring is tensors."""


@dataclass(frozen=True)
class PlainLiquid(_Plain, LiquidBatch):
    """A liquid at one moment (see `LiquidBatch`) whose wiring is tensors."""


@dataclass(frozen=True)
class PlainWiring(_Plain):
    """Wiring alone, as tensors."""


def wiring_fields(
    nodes: Float[torch.Tensor, "nodes 1"],
    to: Int[torch.Tensor, " directed"],
    source: Int[torch.Tensor, " directed"],
    pairs: Int[torch.Tensor, "pairs 2"] | None = None,
    rows: Int[torch.Tensor, "pairs 2"] | None = None,
) -> dict:
    """Fields of the base class for one body; `nodes` is any column with a row for each node. Without brackets no
    pairs are needed."""
    none = to.new_zeros(0, 2)
    return {
        "graph": NO_GRAPH,
        "to": to,
        "source": source,
        "halves": NO_HALVES,
        "member": torch.zeros_like(nodes[:, 0], dtype=torch.int64),
        "bodies": 1,
        "share": torch.ones_like(nodes),  # of one body the mean is taken directly
        "pairs": none if pairs is None else pairs,
        "rows": none if rows is None else rows,
    }


def bracket(
    vectors: Float[torch.Tensor, "brackets 3 rank size"],
    energy: Float[torch.Tensor, "brackets size"],
    entropy: Float[torch.Tensor, "brackets size"],
) -> tuple[Float[torch.Tensor, "brackets size"], Float[torch.Tensor, "brackets size"]]:
    """Reversible and irreversible part of projected brackets (DESIGN 4.1): `A (B.e) - B (A.e)` and `C (C.s)`."""
    e, s = energy[:, None], entropy[:, None]
    a, b, c = (_without(vectors[:, k], g) for k, g in enumerate((s, s, e)))
    reversible = a * _dot(b, e) - b * _dot(a, e)
    return reversible.sum(1), (c * _dot(c, s)).sum(1)


def _dot(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return (x * y).sum(-1, keepdim=True)


def _without(x: torch.Tensor, g: torch.Tensor) -> torch.Tensor:
    """`x` without its part along `g`, taken out twice because the first time leaves rounding."""
    square = _dot(g, g).clamp_min(SMALLEST_SQUARE)
    for _ in range(2):
        x = x - _dot(x, g) / square * g
    return x
