"""Locality, depth and context of the processor; a graph's result is its own affair."""

import numpy as np
import pytest
import torch

from tests.tignn.conftest import batch_in_double, loads_of, make_body, random_state, unit_model
from zsdt.tignn.features import NodeState, merge
from zsdt.tignn.message_passing import Processor, receptive_field
from zsdt.tignn.options import Bracket, GraphScale, TignnOptions

SMALL = {"width": 16, "passes": 2, "local_passes": 1}


def reached(context: bool, passes: int = 3) -> np.ndarray:
    """Nodes of a chain whose latents change when the features of node 0 do."""
    body = make_body((9, 1, 1))
    body.pairs = np.array([(i, i + 1) for i in range(body.nodes - 1)])
    batch = batch_in_double(body)
    torch.manual_seed(0)
    processor = Processor(5, 3, 8, 1, passes, shared=False, context=context).double()
    node, edge = torch.randn(body.nodes, 5).double(), batch.arm
    other = node.clone()
    other[0] += 1.0
    with torch.inference_mode():
        difference = (processor(batch, node, edge) - processor(batch, other, edge)).abs().max(1).values
    return np.nonzero(difference.numpy() > 0)[0]


def test_a_pass_carries_one_edge_and_no_further() -> None:
    assert reached(context=False, passes=3).tolist() == [0, 1, 2, 3]


def test_the_virtual_node_spans_the_graph() -> None:
    assert len(reached(context=True, passes=2)) == 40


def test_shared_weights_do_not_grow_with_depth() -> None:
    sizes = {
        (shared, passes): sum(p.numel() for p in Processor(5, 3, 8, 1, passes, shared, True).parameters())
        for shared in (True, False)
        for passes in (1, 4)
    }
    assert sizes[True, 1] == sizes[True, 4] == sizes[False, 1]
    assert sizes[False, 4] > 3 * sizes[False, 1]


def test_the_bound_beside_the_depth() -> None:
    # c = 60 m/s, 5 ms, 5 cm: sqrt(2) 60 0.005 / 0.05 = 8.5 passes; a beam of 80 cm has 16 pitches.
    line = receptive_field(7, 0.05, 0.005, 0.8, 60.0)
    assert "7 passes" in line and "8.5" in line and "16" in line
    assert "unknown" in receptive_field(7, 0.05, 0.005, 0.8, None)


@pytest.mark.parametrize("bracket", list(Bracket))
@pytest.mark.parametrize("scale", list(GraphScale))
def test_a_graph_does_not_depend_on_its_batch(bracket: Bracket, scale: GraphScale) -> None:
    options = TignnOptions(**SMALL, bracket=bracket, graph_scale=scale)
    model = unit_model(options)
    bodies = [make_body((4, 2, 2)), make_body((3, 1, 2), seed=1), make_body((2, 2, 1), seed=2)]
    batches, states = (
        [batch_in_double(b) for b in bodies],
        [random_state(b, options, 5 + k) for k, b in enumerate(bodies)],
    )
    loads = [loads_of(b, k) for k, b in enumerate(bodies)]
    joined = NodeState(**{name: torch.cat([getattr(s, name) for s in states]) for name in vars(states[0])})
    with torch.inference_mode():
        together = model(merge(batches), joined, *(torch.cat(x) for x in zip(*loads, strict=True))).state
        start = 0
        for batch, state, load in zip(batches, states, loads, strict=True):
            alone = model(batch, state, *load).state
            rows = slice(start, start := start + len(state.velocity))
            for name in ("displacement", "velocity", "stress"):
                a, b = getattr(alone, name), getattr(together, name)[rows]
                assert (a - b).abs().max() <= 1e-12 * a.abs().max()


def test_merged_graphs_are_sorted_by_receiver() -> None:
    merged = merge([batch_in_double(make_body((3, 1, 1))), batch_in_double(make_body((2, 2, 1)))])
    graph = merged.graph
    to = np.repeat(np.arange(graph.nodes), np.diff(graph.offset))
    assert np.array_equal(to, merged.to.numpy())
    first, second = merged.halves.T
    assert np.array_equal(np.stack([to[first], to[second]], 1), graph.pairs)
    assert np.array_equal(graph.neighbour[first], graph.pairs[:, 1])
    assert torch.allclose(merged.arm[first], -merged.arm[second])
