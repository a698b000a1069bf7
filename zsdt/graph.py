"""Graphs: brick grids, undirected pairs, and batches of graphs of different bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Graph:
    """Undirected graph of one body or of a batch of bodies.

    pairs [pairs, 2]: each edge once. offset [nodes + 1], neighbour [2 pairs], pair [2 pairs], sign [2 pairs]: the
    same edges as seen by their receivers, sorted by receiver (CSR); `pair` says which row of `pairs` an entry is
    and `sign` is +1 where the receiver is its first node. member [nodes]: which body of the batch a node is of.
    """

    pairs: Int[np.ndarray, "pairs 2"]
    offset: Int[np.ndarray, " rows"]
    neighbour: Int[np.ndarray, " directed"]
    pair: Int[np.ndarray, " directed"]
    sign: Float[np.ndarray, " directed"]
    member: Int[np.ndarray, " nodes"]

    @property
    def nodes(self) -> int:
        """Number of nodes of all bodies."""
        return len(self.member)

    @property
    def bodies(self) -> int:
        """Number of bodies in the batch."""
        return int(self.member[-1]) + 1 if len(self.member) else 0


def graph_of(nodes: int, pairs: Int[np.ndarray, "pairs 2"], member: Int[np.ndarray, " nodes"] | None = None) -> Graph:
    """Graph with `nodes` nodes and the undirected `pairs`."""
    receiver = np.concatenate([pairs[:, 0], pairs[:, 1]])
    neighbour = np.concatenate([pairs[:, 1], pairs[:, 0]])
    which = np.tile(np.arange(len(pairs)), 2)
    sign = np.repeat([1.0, -1.0], len(pairs))
    order = np.argsort(receiver, kind="stable")
    offset = np.searchsorted(receiver[order], np.arange(nodes + 1))
    return Graph(
        pairs=pairs.astype(np.int64),
        offset=offset.astype(np.int64),
        neighbour=neighbour[order].astype(np.int64),
        pair=which[order].astype(np.int64),
        sign=sign[order],
        member=np.zeros(nodes, np.int64) if member is None else member,
    )


def batch_graphs(graphs: list[Graph]) -> Graph:
    """One graph that holds all of `graphs` side by side, without edges between them."""
    starts = np.cumsum([0] + [g.nodes for g in graphs])
    member = np.concatenate([np.full(g.nodes, k, np.int64) for k, g in enumerate(graphs)])
    pairs = np.concatenate([g.pairs + s for g, s in zip(graphs, starts[:-1], strict=True)])
    return graph_of(int(starts[-1]), pairs, member)


@dataclass(frozen=True)
class BrickGrid:
    """Regular grid of bricks: points [nodes, 3] m (x fastest), cells [cells, 8] (local node x + 2 y + 4 z), pairs."""

    points: Float[np.ndarray, "nodes 3"]
    cells: Int[np.ndarray, "cells 8"]
    pairs: Int[np.ndarray, "pairs 2"]
    counts: tuple[int, int, int]


def brick_grid(counts: tuple[int, int, int], pitch: float) -> BrickGrid:
    """Grid of `counts` cells of edge `pitch` [m] along x, y, z; its undirected pairs are the cell edges."""
    nx, ny, nz = counts
    index = np.arange((nx + 1) * (ny + 1) * (nz + 1)).reshape(nz + 1, ny + 1, nx + 1)
    z, y, x = np.meshgrid(np.arange(nz + 1), np.arange(ny + 1), np.arange(nx + 1), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1) * pitch
    corners = [(a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1)]
    cells = np.stack([index[c : nz + c, b : ny + b, a : nx + a].ravel() for a, b, c in corners], axis=1)
    pairs = np.concatenate(
        [
            np.stack([index[:, :, :-1].ravel(), index[:, :, 1:].ravel()], axis=1),
            np.stack([index[:, :-1, :].ravel(), index[:, 1:, :].ravel()], axis=1),
            np.stack([index[:-1, :, :].ravel(), index[1:, :, :].ravel()], axis=1),
        ]
    )
    return BrickGrid(points=points, cells=cells, pairs=pairs, counts=counts)
