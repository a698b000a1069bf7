"""Nodes, order, holes, clutter and clamp side on painted grids of which every node is known in closed form."""

import cv2
import numpy as np
import pytest

from tests.perception.painted_grid import Face, with_holes
from zsdt.errors import DataError, OptionError
from zsdt.perception.camera import ClampSide
from zsdt.perception.grid_graph import ClampChoice, GridOptions, extract_grid

cv2.setNumThreads(1)
LEFT = GridOptions(clamp_side=ClampChoice.left)


def errors(graph, face: Face) -> np.ndarray:
    """Distance of each node from the true one [px]."""
    assert graph.pixels.shape == face.nodes.shape
    return np.linalg.norm(graph.pixels - face.nodes, axis=-1)


@pytest.mark.parametrize(
    ("face", "cut"),
    [
        (Face(), False),
        (Face(), True),  # outlines show their inner half only
        (Face(mirrored=True), True),
        (Face(cells=(16, 6), pitch=22.0, bend=0.3), True),
        (Face(cells=(14, 3), pitch=45.0, bend=0.8), True),
        (Face(bend=1e-6), True),
    ],
    ids=["whole outlines", "cut outlines", "mirrored", "small pitch", "strongly bent", "straight"],
)
def test_every_node_is_found_to_a_fraction_of_a_pixel(face, cut):
    paint = face.coverage(width=3.0 if face.pitch < 30 else 5.0, cut=cut)
    graph = extract_grid(paint, face.picture(paint))
    off = errors(graph, face)
    assert np.median(off) < 0.2 and off.max() < 0.5
    assert graph.found.all() and graph.linked.all()
    assert graph.clamp_side is (ClampSide.right if face.mirrored else ClampSide.left)
    assert graph.pitch_px == pytest.approx(face.pitch, rel=0.02)
    assert graph.pitch_spread < 0.02
    assert len(graph.edges) == 2 * graph.found.size - graph.columns - graph.rows


def test_edges_join_neighbours_of_the_lattice():
    face = Face(cells=(5, 3))
    graph = extract_grid(face.coverage(), None, LEFT)
    steps = np.diff(np.stack(np.unravel_index(graph.edges, graph.found.shape), axis=-1), axis=1)[:, 0]
    assert (np.abs(steps).sum(axis=1) == 1).all()
    assert len(np.unique(graph.edges, axis=0)) == len(graph.edges)


@pytest.mark.parametrize("seed", range(3))
def test_with_a_fifth_of_the_paint_erased_the_order_stands_and_losses_are_said(seed):
    face = Face()
    paint = face.coverage()
    graph = extract_grid(with_holes(paint, 0.2, radius=8, seed=seed), face.picture(paint))
    off = errors(graph, face)
    assert np.median(off) < 0.3
    assert graph.found.mean() > 0.7
    assert off[graph.found].max() < 0.12 * face.pitch
    assert off.max() < 0.25 * face.pitch  # those that were filled in
    assert not graph.linked.all()


def test_a_hole_is_bridged_and_its_node_reported_as_not_seen():
    face = Face()
    paint = face.coverage()
    u, v = np.rint(face.nodes[6, 2]).astype(int)
    paint[v - 33 : v + 34, u - 33 : u + 34] = 0
    graph = extract_grid(paint, None, LEFT)
    assert not graph.found[6, 2]
    assert graph.found.sum() == graph.found.size - 1
    off = errors(graph, face)
    assert off[6, 2] < 0.08 * face.pitch and np.median(off) < 0.2


def test_a_column_that_is_hidden_does_not_end_the_grid():
    face = Face(cells=(12, 4), bend=0.2)
    paint = face.coverage()
    hidden = face.nodes[5, :, 0]
    paint[:, int(hidden.min()) - 14 : int(hidden.max()) + 15] = 0  # a pole stands before it
    graph = extract_grid(paint, None, LEFT)
    off = errors(graph, face)
    assert not graph.found[5].any() and graph.found[[0, 1, 2, 3, 7, 8, 9, 10, 11, 12]].all()
    assert off[graph.found].max() < 1.0 and off.max() < 0.15 * face.pitch


@pytest.mark.parametrize("pitch", [20, 40])
def test_a_smaller_grid_beside_the_beam_is_ignored(pitch):
    face = Face()
    paint = face.coverage()
    for k in range(6):
        cv2.line(paint, (720 + k * pitch, 40), (720 + k * pitch, 40 + 5 * pitch), 1.0, 2)
        cv2.line(paint, (720, 40 + k * pitch), (720 + 5 * pitch, 40 + k * pitch), 1.0, 2)
    graph = extract_grid(paint, face.picture(face.coverage()))
    assert np.median(errors(graph, face)) < 0.2 and graph.found.all()


def test_lines_of_text_across_the_face_do_not_move_the_nodes_far():
    face = Face()
    text = np.zeros(face.size[::-1], np.uint8)
    cv2.putText(text, "FOAM 42", (260, 300), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 255, 2, cv2.LINE_AA)
    graph = extract_grid(np.maximum(face.coverage(), text.astype(np.float32) / 255), None, LEFT)
    off = errors(graph, face)
    assert np.median(off) < 0.2 and off[graph.found].max() < 0.25 * face.pitch


def test_noise_on_the_probability_changes_nodes_by_less_than_half_a_pixel():
    face = Face()
    noise = np.random.default_rng(0).normal(0, 0.15, face.size[::-1])
    paint = np.clip(cv2.GaussianBlur(face.coverage(cut=True), (0, 0), 1.0) + noise, 0, 1).astype(np.float32)
    off = errors(extract_grid(paint, None, LEFT), face)
    assert np.median(off) < 0.5 and off.max() < 2.0


def test_nodes_outside_of_the_picture_are_not_seen():
    face = Face(cells=(14, 3), pitch=45.0, bend=1.2)  # its tip hangs out of the picture
    graph = extract_grid(face.coverage(), None, LEFT)
    inside = (face.nodes[: graph.columns, :, 1] < face.size[1] - 0.5) & graph.found
    assert (inside == graph.found).all() and not graph.found.all()


def test_a_picture_and_its_mirror_image_give_the_same_grid():
    face = Face(bend=0.4)
    paint = with_holes(face.coverage(cut=True), 0.05, radius=6)
    image = face.picture(paint)
    one = extract_grid(paint, image)
    other = extract_grid(np.ascontiguousarray(paint[:, ::-1]), np.ascontiguousarray(image[:, ::-1]))
    assert (one.clamp_side, other.clamp_side) == (ClampSide.left, ClampSide.right)
    back = other.pixels * [-1, 1] + [face.size[0] - 1, 0]
    both = one.found & other.found
    assert both.mean() > 0.95
    assert np.median(np.linalg.norm(one.pixels - back, axis=-1)[both]) < 0.05


@pytest.mark.parametrize("what", ["nothing", "two lines", "specks", "random lines", "noise", "coarse noise"])
def test_no_grid_says_why(what):
    paint = np.zeros((540, 960), np.float32)
    rng = np.random.default_rng(0)
    if what == "two lines":
        cv2.line(paint, (50, 50), (800, 400), 1.0, 4)
        cv2.line(paint, (50, 350), (800, 100), 1.0, 4)
    elif what == "specks":
        paint[rng.integers(0, 540, 300), rng.integers(0, 960, 300)] = 1.0
    elif what == "noise":
        paint[:] = rng.random(paint.shape)
    elif what == "coarse noise":
        paint[:] = cv2.resize(rng.random((90, 160)).astype(np.float32), (960, 540))
    elif what == "random lines":
        for a, b in rng.integers(0, 540, (25, 2, 2)):
            cv2.line(paint, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), 1.0, 3)
    with pytest.raises(DataError, match="grid"):
        extract_grid(paint)


def test_the_clamp_is_asked_for_where_it_cannot_be_told():
    straight = Face(bend=1e-6)
    paint = straight.coverage(cut=True)
    with pytest.raises(DataError, match="clamp_side"):
        extract_grid(paint, straight.picture(paint, clamp_block=False))
    told = extract_grid(paint, None, GridOptions(clamp_side=ClampChoice.right))
    np.testing.assert_allclose(told.pixels[::-1], straight.nodes, atol=0.5)


def test_a_block_at_the_end_that_hangs_is_a_contradiction():
    face = Face(bend=0.6)
    paint = face.coverage(cut=True)
    image = face.picture(paint, clamp_block=False)
    up, out = face.nodes[-1, -1] - face.nodes[-1, 0], face.nodes[-1, 0] - face.nodes[-2, 0]
    low, high = face.nodes[-1, 0] - 0.2 * up + 0.05 * out, face.nodes[-1, -1] + 0.2 * up + 0.05 * out
    block = np.rint([low, high, high + 1.5 * out, low + 1.5 * out]).astype(np.int32)
    cv2.fillPoly(image, [block], (35, 35, 40))
    with pytest.raises(DataError, match="Say clamp_side"):
        extract_grid(paint, image)


def test_options_refuse_nonsense():
    with pytest.raises(OptionError, match="threshold"):
        GridOptions(threshold=1.5)
    with pytest.raises(OptionError, match="columns"):
        GridOptions(min_columns=1)
