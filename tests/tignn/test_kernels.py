"""The fused message kernel against plain torch operations and finite differences."""

import numpy as np
import pytest
import torch

from zsdt.graph import Graph, batch_graphs, brick_grid, graph_of
from zsdt.tignn.kernels import sum_messages, sum_messages_reference


def random_graph(seed: int, nodes: int = 9, pairs: int = 14) -> Graph:
    draw = np.random.default_rng(seed)
    every = np.array([(i, j) for i in range(nodes) for j in range(i + 1, nodes)])
    return graph_of(nodes, every[draw.choice(len(every), pairs, replace=False)])


def inputs(graph: Graph, dtype: torch.dtype, width: int = 6, features: int = 4) -> list[torch.Tensor]:
    torch.manual_seed(3)
    shapes = [(graph.nodes, width), (graph.nodes, width), (features, width), (len(graph.neighbour), features)]
    return [torch.randn(*s, dtype=dtype, requires_grad=True) for s in shapes]


def test_gradient_agrees_with_finite_differences() -> None:
    graph = random_graph(1)
    assert torch.autograd.gradcheck(lambda *a: sum_messages(graph, *a), inputs(graph, torch.float64))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_value_and_gradient_agree_with_torch(dtype: torch.dtype, tolerance: float) -> None:
    grid = brick_grid((4, 2, 2), 0.05)
    graph = graph_of(len(grid.points), grid.pairs)
    found = []
    for function in (sum_messages, sum_messages_reference):
        arguments = inputs(graph, dtype, width=16)
        out = function(graph, *arguments)
        found.append([out, *torch.autograd.grad(out.square().sum(), arguments)])
    for fused, plain in zip(*found, strict=True):
        assert (fused - plain).abs().max() <= tolerance * plain.abs().max()


def test_edges_without_gradient_cost_no_array() -> None:
    graph = random_graph(2)
    sender, receiver, weight, edge = inputs(graph, torch.float32)
    out = sum_messages(graph, sender, receiver, weight, edge.detach())
    assert out.grad_fn is not None
    out.sum().backward()
    assert edge.grad is None and weight.grad is not None


def test_a_node_without_neighbours_receives_nothing_and_batches_do_not_mix() -> None:
    lonely = graph_of(3, np.array([[0, 1]]))
    arguments = inputs(lonely, torch.float64)
    out = sum_messages(lonely, *arguments)
    assert torch.equal(out[2], torch.zeros_like(out[2]))

    one, two = random_graph(4), random_graph(5, nodes=7, pairs=8)
    both = batch_graphs([one, two])
    a, b = inputs(one, torch.float64), inputs(two, torch.float64)
    # Edges of the batch are sorted by receiver, so those of the first graph come first.
    joined = sum_messages(both, *(torch.cat([x, y]) for x, y in zip(a[:2], b[:2], strict=True)), a[2],
                          torch.cat([a[3], b[3]]))  # fmt: skip
    alone = torch.cat([sum_messages(one, *a[:3], a[3]), sum_messages(two, *b[:2], a[2], b[3])])
    assert torch.allclose(joined, alone, rtol=0, atol=1e-14)
