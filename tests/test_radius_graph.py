"""Radius graph against scipy's k-d tree, its order, and the promise of the Verlet skin."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from zsdt.errors import OptionError, RunRejected
from zsdt.graph import graph_of
from zsdt.radius_graph import RadiusGraph, fill_neighbours, radius_graph, radius_pairs, workspace


def cloud(kind, seed=0):
    draw = np.random.default_rng(seed)
    if kind == "glass":
        return draw.uniform([-0.035, -0.035, 0], [0.035, 0.035, 0.06], (900, 3))
    if kind == "clustered":
        centres = draw.uniform(-0.03, 0.03, (8, 3))
        return centres[draw.integers(8, size=400)] + 0.002 * draw.standard_normal((400, 3))
    if kind == "line":
        return np.stack([0.004 * np.arange(50), np.zeros(50), np.zeros(50)], axis=1)
    if kind == "one place":
        return np.full((30, 3), 0.01)
    if kind == "strays":
        return np.concatenate([cloud("glass")[:200], [[1e6, 0, 0], [0, -3e9, 2], [1e6, 0.001, 0]]])
    return draw.standard_normal((int(kind), 3)) * 0.003


def tree_pairs(points, radius):
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray").reshape(-1, 2)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


@pytest.mark.parametrize("kind", ["glass", "clustered", "line", "one place", "strays", "1", "2", "3"])
@pytest.mark.parametrize("radius", [0.003, 0.0113, 0.5])
def test_pairs_are_those_of_a_kd_tree(kind, radius):
    points = cloud(kind)
    np.testing.assert_array_equal(radius_pairs(points, radius), tree_pairs(points, radius))


def test_lists_are_symmetric_and_sorted_by_receiver_and_neighbour():
    built = RadiusGraph(0.011, 0.002)
    built.update(cloud("glass"))
    to = np.repeat(np.arange(900), np.diff(built.offset))
    directed = to * 900 + built.neighbour
    assert built.neighbour.dtype == np.int32
    assert (np.diff(directed) > 0).all()
    np.testing.assert_array_equal(np.sort(built.neighbour.astype(np.int64) * 900 + to), directed)


def test_graph_holds_the_same_edges_as_one_made_from_its_pairs():
    ours = radius_graph(cloud("glass"), 0.011)
    theirs = graph_of(900, ours.pairs)
    to = np.repeat(np.arange(900), np.diff(ours.offset))
    np.testing.assert_array_equal(ours.offset, theirs.offset)
    np.testing.assert_array_equal(ours.pairs[ours.pair, np.where(ours.sign > 0, 0, 1)], to)
    np.testing.assert_array_equal(ours.pairs[ours.pair, np.where(ours.sign > 0, 1, 0)], ours.neighbour)
    # Rows hold the same neighbours, here in ascending order.
    order = np.lexsort((theirs.neighbour, to))
    np.testing.assert_array_equal(ours.neighbour, theirs.neighbour[order])


def test_no_particle_at_all_is_an_empty_graph():
    assert radius_pairs(np.zeros((0, 3)), 0.01).shape == (0, 2)


def test_skin_keeps_the_list_until_somebody_has_moved_half_of_it_and_never_misses_a_pair():
    points, radius, skin = cloud("glass"), 0.009, 0.003
    draw, built, rebuilt = np.random.default_rng(3), RadiusGraph(radius, skin), []
    heading = draw.standard_normal(points.shape)
    for _ in range(30):
        rebuilt.append(built.update(points))
        pairs = built.pairs
        near = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) <= radius
        np.testing.assert_array_equal(pairs[near], tree_pairs(points, radius))
        points = points + 1e-4 * heading
    assert rebuilt[0] and 1 < sum(rebuilt) < 20
    assert built.builds == sum(rebuilt) and built.reused == 1 - built.builds / 30


def test_one_particle_that_leaves_the_first_box_is_followed():
    points, built = cloud("glass").copy(), RadiusGraph(0.01, 0.002)
    built.update(points)
    points[7] = [0.3, -0.2, 0.9]
    assert built.update(points)
    np.testing.assert_array_equal(built.pairs, tree_pairs(points, 0.012))
    points[7, 2] += 0.0009
    assert not built.update(points)


def test_another_number_of_particles_builds_anew():
    built = RadiusGraph(0.01, 0.002)
    assert built.update(cloud("glass")) and built.update(cloud("glass")[:-1])
    assert len(built.offset) == 900


def test_a_steady_state_keeps_its_buffers():
    built = RadiusGraph(0.01)
    built.update(cloud("glass"))
    before = built.neighbour.__array_interface__["data"][0]
    built.update(cloud("glass") + 1e-5)
    assert built.neighbour.__array_interface__["data"][0] == before


def test_too_small_arrays_are_told_what_they_need():
    points = cloud("clustered")
    small = np.empty(10, np.int32)
    offset = np.empty(len(points) + 1, np.int32)
    needed = fill_neighbours(points, 0.01, *workspace(len(points)), offset, small, small.copy())
    assert needed == 2 * len(tree_pairs(points, 0.01))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308])
def test_positions_that_are_not_finite_are_refused(bad):
    points, built = cloud("glass").copy(), RadiusGraph(0.01, 0.001)
    built.update(points)
    points[5, 1], points[6, 1] = bad, -bad
    with pytest.raises(RunRejected, match="not a finite number"):
        built.update(points)


@pytest.mark.parametrize(("radius", "skin"), [(0.0, 0.0), (-1.0, 0.0), (0.01, -1e-3), (float("nan"), 0.0)])
def test_impossible_radii_are_refused(radius, skin):
    with pytest.raises(OptionError, match="radius > 0"):
        RadiusGraph(radius, skin)
