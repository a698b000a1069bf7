"""Twins on other grids than the truth's, held against it: exact for what is linear between nodes."""

import numpy as np
import pytest

from tests.tignn.cell_bodies import body_of
from zsdt.errors import DataError
from zsdt.planning.on_truth import between_nodes, truth_at
from zsdt.solid.mesh import BrickMesh
from zsdt.trajectory import Trajectory


def body_with(counts, pitch):
    body = body_of((2, 1, 1))
    grid = BrickMesh(counts, pitch).grid
    body.points, body.pitch, body.cells, body.pairs = grid.points, pitch, grid.cells, grid.pairs
    body.clamped, body.mass = grid.points[:, 0] < 1e-9, np.ones(len(grid.points))
    return body


def test_a_field_that_is_linear_along_each_axis_is_exact_on_any_grid():
    fine, coarse = body_with((8, 4, 4), 0.025), body_with((2, 1, 1), 0.1)

    def field(x):
        return (1 + x[:, 0]) * (2 - 3 * x[:, 1]) * (1 + 5 * x[:, 2])

    for ours, theirs in ((coarse, fine), (fine, coarse)):
        np.testing.assert_allclose(between_nodes(ours, theirs.points) @ field(ours.points), field(theirs.points))


def test_weights_are_a_mean_and_a_node_is_itself():
    body = body_with((4, 2, 2), 0.05)
    weights = between_nodes(body, body.points)
    np.testing.assert_allclose(weights.toarray(), np.eye(body.nodes), atol=1e-12)
    rng = np.random.default_rng(0)
    inside = rng.random((50, 3)) * np.ptp(body.points, axis=0)
    np.testing.assert_allclose(np.asarray(between_nodes(body, inside).sum(axis=1)), 1.0)


def test_one_layer_says_the_same_all_over_the_width():
    layer, truth = body_with((4, 1, 2), 0.05), body_with((4, 5, 2), 0.05)
    values = layer.points[:, 0] + 7 * layer.points[:, 2]
    found = between_nodes(layer, truth.points, any_width=True) @ values
    np.testing.assert_allclose(found, truth.points[:, 0] + 7 * truth.points[:, 2])


def test_a_truth_that_reaches_beyond_the_body_is_refused():
    with pytest.raises(DataError, match="beyond the twin's body"):
        between_nodes(body_with((4, 2, 2), 0.05), body_with((5, 2, 2), 0.05).points)


def test_the_truth_on_the_side_that_the_camera_sees():
    truth_body, layer = body_with((4, 4, 2), 0.05), body_with((4, 1, 2), 0.05)
    lean = np.array([0.0, 0.0, 0.01]) * truth_body.points[:, 1:2]
    position = (truth_body.points + lean)[None].repeat(2, axis=0)
    truth = Trajectory(truth_body, np.arange(2.0), {"position": position}, np.zeros_like(position), {}, {})
    for far, low in ((False, 0.0), (True, 0.15)):
        there = truth_at(layer, truth, far).fields["position"] - layer.points
        np.testing.assert_allclose(there[0, :, 2], 0.01 * (layer.points[:, 1] + low), atol=1e-12)
