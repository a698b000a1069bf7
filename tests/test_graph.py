"""Grids, undirected pairs, the same edges as their receivers see them, and batches."""

import numpy as np
import pytest

from zsdt.graph import batch_graphs, brick_grid, graph_of


@pytest.mark.parametrize("counts", [(1, 1, 1), (3, 2, 1), (4, 3, 5)])
def test_grid_has_the_counts_the_volume_and_the_edges_of_a_brick(counts):
    nx, ny, nz = counts
    grid = brick_grid(counts, 0.05)
    assert len(grid.points) == (nx + 1) * (ny + 1) * (nz + 1) and len(grid.cells) == nx * ny * nz
    edges = nx * (ny + 1) * (nz + 1) + (nx + 1) * ny * (nz + 1) + (nx + 1) * (ny + 1) * nz
    assert len(np.unique(grid.pairs, axis=0)) == len(grid.pairs) == edges
    assert (grid.pairs[:, 0] < grid.pairs[:, 1]).all()
    np.testing.assert_allclose(np.linalg.norm(np.diff(grid.points[grid.pairs], axis=1), axis=2), 0.05)
    np.testing.assert_allclose(grid.points.max(axis=0), 0.05 * np.array(counts))
    np.testing.assert_allclose(grid.points[1] - grid.points[0], [0.05, 0, 0])  # x runs fastest


def test_corners_of_a_cell_are_numbered_x_then_y_then_z():
    grid = brick_grid((3, 2, 2), 0.1)
    offsets = grid.points[grid.cells] - grid.points[grid.cells[:, :1]]
    local = np.arange(8)
    wanted = 0.1 * np.stack([local & 1, local >> 1 & 1, local >> 2 & 1], axis=1)
    np.testing.assert_allclose(offsets, np.broadcast_to(wanted, offsets.shape), atol=1e-12)


def random_graph(seed, nodes=12):
    random = np.random.default_rng(seed)
    pairs = np.unique(np.sort(random.integers(0, nodes, size=(30, 2)), axis=1), axis=0)
    return graph_of(nodes, pairs[pairs[:, 0] < pairs[:, 1]])


def test_receivers_see_every_edge_from_both_ends():
    graph = random_graph(1)
    assert graph.offset[0] == 0 and graph.offset[-1] == 2 * len(graph.pairs) == len(graph.neighbour)
    receiver = np.repeat(np.arange(graph.nodes), np.diff(graph.offset))
    mine, other = graph.pairs[graph.pair].T
    forward = graph.sign > 0
    np.testing.assert_array_equal(receiver, np.where(forward, mine, other))
    np.testing.assert_array_equal(graph.neighbour, np.where(forward, other, mine))
    np.testing.assert_array_equal(np.bincount(graph.pair), 2)
    np.testing.assert_array_equal(np.bincount(graph.pair, graph.sign), 0)


def test_what_is_exchanged_in_opposite_signs_adds_up_to_nothing():
    graph = random_graph(2)
    impulse = np.random.default_rng(0).normal(size=(len(graph.pairs), 3))
    received = np.zeros((graph.nodes, 3))
    for node in range(graph.nodes):
        rows = slice(graph.offset[node], graph.offset[node + 1])
        received[node] = (graph.sign[rows, None] * impulse[graph.pair[rows]]).sum(axis=0)
    scattered = np.zeros_like(received)
    np.add.at(scattered, graph.pairs[:, 0], impulse)
    np.add.at(scattered, graph.pairs[:, 1], -impulse)
    np.testing.assert_allclose(received, scattered, atol=1e-12)
    np.testing.assert_allclose(received.sum(axis=0), 0.0, atol=1e-12)


def test_a_node_without_edges_has_an_empty_row():
    graph = graph_of(4, np.array([[0, 2]]))
    np.testing.assert_array_equal(np.diff(graph.offset), [1, 0, 1, 0])


def test_bodies_of_a_batch_do_not_touch_and_keep_their_own_edges():
    graphs = [random_graph(3, 12), graph_of(2, np.array([[0, 1]])), random_graph(4, 7)]
    batch = batch_graphs(graphs)
    assert batch.bodies == 3 and batch.nodes == sum(g.nodes for g in graphs)
    np.testing.assert_array_equal(np.bincount(batch.member), [g.nodes for g in graphs])
    np.testing.assert_array_equal(batch.member[batch.pairs[:, 0]], batch.member[batch.pairs[:, 1]])
    start = 0
    for k, graph in enumerate(graphs):
        own = batch.pairs[batch.member[batch.pairs[:, 0]] == k] - start
        np.testing.assert_array_equal(own, graph.pairs)
        rows = slice(batch.offset[start], batch.offset[start + graph.nodes])
        np.testing.assert_array_equal(batch.neighbour[rows] - start, graph.neighbour)
        np.testing.assert_array_equal(batch.sign[rows], graph.sign)
        start += graph.nodes
