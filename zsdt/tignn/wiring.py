"""Who talks to whom in a batch of graphs: all that message passing and brackets need to know of a body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from zsdt.graph import Graph
from zsdt.tignn.bracket_kernels import sum_brackets
from zsdt.tignn.kernels import sum_messages


@dataclass(frozen=True)
class Wiring:
    """One graph, or several side by side.

    graph: CSR, sorted by receiver. to, source [directed]: receiver and sender of an edge; halves [pairs, 2]: where
    the two directed halves of an undirected edge lie (that of its first node first). member [nodes]: body of a node;
    share [nodes, 1]: one over the nodes of its body.
    """

    graph: Graph
    to: torch.Tensor
    source: torch.Tensor
    halves: Int[np.ndarray, "pairs 2"]
    member: torch.Tensor
    bodies: int
    share: torch.Tensor

    def mean(self, values: Float[torch.Tensor, "nodes width"]) -> Float[torch.Tensor, "bodies width"]:
        """Mean over the nodes of each body."""
        if self.bodies == 1:
            return values.mean(0, keepdim=True)
        empty = values.new_zeros(self.bodies, values.shape[1])
        return empty.index_add(0, self.member, values * self.share)

    def messages(
        self,
        sender: Float[torch.Tensor, "nodes width"],
        receiver: Float[torch.Tensor, "nodes width"],
        weight: Float[torch.Tensor, "features width"],
        edge: Float[torch.Tensor, "directed features"],
    ) -> Float[torch.Tensor, "nodes width"]:
        """What arrives at every node (see `sum_messages`)."""
        return sum_messages(self.graph, sender, receiver, weight, edge)

    def brackets(
        self,
        edges: Float[torch.Tensor, "directed 3 rank d"],
        nodes: Float[torch.Tensor, "nodes 3 rank d"],
        energy: Float[torch.Tensor, "nodes d"],
        entropy: Float[torch.Tensor, "nodes d"],
    ) -> tuple[Float[torch.Tensor, "nodes d"], Float[torch.Tensor, "nodes d"]]:
        """Reversible and irreversible part per node of the brackets of all pairs and all nodes (see `sum_brackets`)."""
        reversible, irreversible = sum_brackets(self.graph.pairs, self.halves, edges, energy, entropy)
        own = np.arange(len(nodes))[:, None]
        bulk, friction = sum_brackets(own, own, nodes, energy, entropy)
        return reversible + bulk, irreversible + friction


def merge_wirings(parts: list[Wiring]) -> Wiring:
    """Several wirings side by side. Each is sorted by receiver, so nothing needs sorting again."""
    nodes = np.cumsum([0] + [b.graph.nodes for b in parts])
    edges = np.cumsum([0] + [len(b.graph.neighbour) for b in parts])
    pairs = np.cumsum([0] + [len(b.graph.pairs) for b in parts])
    bodies = np.cumsum([0] + [b.bodies for b in parts])

    def shifted(pick, starts: Int[np.ndarray, " parts"]) -> np.ndarray:
        return np.concatenate([pick(b.graph) + s for b, s in zip(parts, starts, strict=False)])

    graph = Graph(
        pairs=shifted(lambda g: g.pairs, nodes),
        offset=np.append(shifted(lambda g: g.offset[:-1], edges), edges[-1]),
        neighbour=shifted(lambda g: g.neighbour, nodes),
        pair=shifted(lambda g: g.pair, pairs),
        sign=np.concatenate([b.graph.sign for b in parts]),
        member=shifted(lambda g: g.member, bodies),
    )
    return Wiring(
        graph=graph,
        to=torch.cat([b.to + int(s) for b, s in zip(parts, nodes, strict=False)]),
        source=torch.from_numpy(graph.neighbour),
        halves=np.concatenate([b.halves + s for b, s in zip(parts, edges, strict=False)]),
        member=torch.from_numpy(graph.member),
        bodies=int(bodies[-1]),
        share=torch.cat([b.share for b in parts]),
    )
