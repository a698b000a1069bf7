"""Fused gather-MLP-scatter on a CSR graph, with its own gradient (DESIGN 4.4).

One pass of message passing sums, for every receiver, the activated first layer of an edge network over the edges
that arrive there. The layer is factorised, `W_e e_ij + W_s h_j + W_d h_i`, so the node products are two dense
matrix products outside and the edge work is a short loop that never leaves the cache: no array of the size
[edges, width] is ever written. The backward loop computes the first layer again instead of keeping it.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float

from zsdt.graph import Graph

# One core, one thread: jobs run side by side, one per core (DESIGN 4.4).
_jit: Any = numba.njit(fastmath=True, error_model="numpy", cache=True, nogil=True)


@_jit
@no_type_check
def _sum_messages(offset, neighbour, edge, sender, receiver, weight, out):
    """out[i] = sum over edges of act(receiver[i] + sender[j] + edge @ weight), act(t) = t/2 (1 + t/(1+|t|))."""
    nodes, width = receiver.shape
    one, half = receiver.dtype.type(1), receiver.dtype.type(0.5)
    layer = np.empty(width, receiver.dtype)
    total = np.empty(width, receiver.dtype)
    for i in range(nodes):
        total[:] = 0
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            for a in range(width):
                layer[a] = receiver[i, a] + sender[j, a]
            for d in range(weight.shape[0]):
                feature = edge[k, d]
                for a in range(width):
                    layer[a] += feature * weight[d, a]
            for a in range(width):
                total[a] += half * layer[a] * (one + layer[a] / (one + abs(layer[a])))
        for a in range(width):
            out[i, a] = total[a]


@_jit
@no_type_check
def _message_gradients(offset, neighbour, edge, sender, receiver, weight, g, g_edge, g_sender, g_receiver, g_weight):
    """Adds the gradients of `_sum_messages` for the output gradient `g`; `g_edge` of no rows is left out."""
    nodes, width = receiver.shape
    one, half = receiver.dtype.type(1), receiver.dtype.type(0.5)
    layer = np.empty(width, receiver.dtype)
    for i in range(nodes):
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            for a in range(width):
                layer[a] = receiver[i, a] + sender[j, a]
            for d in range(weight.shape[0]):
                feature = edge[k, d]
                for a in range(width):
                    layer[a] += feature * weight[d, a]
            for a in range(width):
                shrink = one / (one + abs(layer[a]))
                gate = layer[a] * shrink
                layer[a] = half * (one + gate + gate * shrink) * g[i, a]
            for a in range(width):
                g_receiver[i, a] += layer[a]
            for a in range(width):
                g_sender[j, a] += layer[a]
            for d in range(weight.shape[0]):
                feature = edge[k, d]
                for a in range(width):
                    g_weight[d, a] += feature * layer[a]
            if g_edge.shape[0] > 0:
                for d in range(weight.shape[0]):
                    total = receiver.dtype.type(0)
                    for a in range(width):
                        total += layer[a] * weight[d, a]
                    g_edge[k, d] = total


class _Messages(torch.autograd.Function):
    """Autograd node around the two loops."""

    @staticmethod
    def forward(ctx: Any, sender, receiver, weight, edge, offset, neighbour):
        arrays = [t.detach().contiguous().numpy() for t in (edge, sender, receiver, weight)]
        out = torch.empty_like(receiver)
        _sum_messages(offset, neighbour, *arrays, out.numpy())
        ctx.graph, ctx.arrays = (offset, neighbour), arrays
        return out

    @staticmethod
    def backward(ctx: Any, *gradients):
        edge, sender, receiver, weight = ctx.arrays
        g_sender, g_receiver, g_weight = (torch.zeros(a.shape, dtype=gradients[0].dtype) for a in ctx.arrays[1:])
        rows = edge.shape[0] if ctx.needs_input_grad[3] else 0
        g_edge = torch.empty((rows, edge.shape[1]), dtype=gradients[0].dtype)
        g = gradients[0].contiguous().numpy()
        filled = [t.numpy() for t in (g_edge, g_sender, g_receiver, g_weight)]
        _message_gradients(*ctx.graph, edge, sender, receiver, weight, g, *filled)
        return g_sender, g_receiver, g_weight, g_edge if rows else None, None, None


def activation(x: Float[torch.Tensor, "*shape"]) -> Float[torch.Tensor, "*shape"]:
    """t/2 (1 + t/(1+|t|)): SiLU's shape without an exponential, so that the compiled loop can be vectorised."""
    return 0.5 * x * (1.0 + x / (1.0 + x.abs()))


def sum_messages(
    graph: Graph,
    sender: Float[torch.Tensor, "nodes width"],
    receiver: Float[torch.Tensor, "nodes width"],
    weight: Float[torch.Tensor, "features width"],
    edge: Float[torch.Tensor, "directed features"],
) -> Float[torch.Tensor, "nodes width"]:
    """Sum over the edges that arrive at a node of `activation(receiver_i + sender_j + edge_ij weight)`.

    `edge` [directed, features] is in the graph's CSR order (sorted by receiver). Runs on the CPU, in float32 or
    float64, on one thread.
    """
    return _Messages.apply(sender, receiver, weight, edge, graph.offset, graph.neighbour)


def sum_messages_reference(
    graph: Graph,
    sender: Float[torch.Tensor, "nodes width"],
    receiver: Float[torch.Tensor, "nodes width"],
    weight: Float[torch.Tensor, "features width"],
    edge: Float[torch.Tensor, "directed features"],
) -> Float[torch.Tensor, "nodes width"]:
    """The same as `sum_messages` in plain torch operations: the referee of the tests, and what others run."""
    to = torch.from_numpy(np.repeat(np.arange(graph.nodes), np.diff(graph.offset)))
    layer = activation(receiver[to] + sender[torch.from_numpy(graph.neighbour)] + edge @ weight)
    return torch.zeros_like(receiver).index_add(0, to, layer)
