"""Alignment with the first frame: known shifts come back, light changes nothing, neighbours' fits are exact."""

import cv2
import numpy as np
import pytest

from zsdt.perception.local_motion import fill, lattice_edges, neighbourhoods, smooth_locally, torn_off, warp_operator
from zsdt.perception.reference_patches import align, reference_patches
from zsdt.perception.silhouette import grid_cells, silhouette


@pytest.fixture(scope="module")
def field():
    """A smooth random picture as a function of the pixel: what a shifted or deformed camera would see."""
    rng = np.random.default_rng(3)
    waves = rng.uniform(-0.7, 0.7, (60, 2))
    phase, height = rng.uniform(0, 2 * np.pi, 60), rng.uniform(2, 6, 60)

    def sample(x, y):
        total = np.full(np.shape(x), 120.0)
        for (a, b), shift, amplitude in zip(waves, phase, height, strict=True):
            total = total + amplitude * np.sin(a * x + b * y + shift)
        return total

    return sample


def _eight_bits(image):
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _nodes():
    return np.stack([g.ravel() for g in np.meshgrid([40.3, 70.0, 100.6], [35.5, 62.2])], axis=1)


def _warp(affine):
    return np.concatenate([affine, np.zeros((2, 3))], axis=1)


def test_a_known_affine_motion_is_found_whatever_the_light(field):
    column, row = np.meshgrid(np.arange(150.0), np.arange(110.0))
    nodes, middle = _nodes(), np.array([70.0, 50.0])
    affine = np.array([[0.95, 0.12], [-0.15, 1.04]])
    there = middle + (nodes - middle) @ affine.T + [1.3, -0.8]
    back = np.linalg.inv(affine)
    u, v = column - middle[0] - 1.3, row - middle[1] + 0.8
    moved = field(middle[0] + back[0, 0] * u + back[0, 1] * v, middle[1] + back[1, 0] * u + back[1, 1] * v)
    ramp = 0.6 + 0.002 * column - 0.001 * row
    patches = reference_patches(_eight_bits(field(column, row)), nodes, np.ones((110, 150), np.float32), 0, 21)
    for light in (moved, 0.6 * moved, 30.0 + 0.7 * moved, ramp * moved):
        found = align(
            patches,
            _eight_bits(light),
            there + np.array([1.0, 1.2]),
            np.tile(_warp(affine), (6, 1, 1)),
            np.ones(6, bool),
            4.0,
        )
        assert np.abs(found.pixels - there).max() < 0.03
        assert found.score.min() > 0.99 and found.error.max() < 0.15


def test_what_is_not_the_node_scores_low(field):
    column, row = np.meshgrid(np.arange(150.0), np.arange(110.0))
    nodes = _nodes()
    image = _eight_bits(field(column, row))
    patches = reference_patches(image, nodes, np.ones((110, 150), np.float32), 0, 21)
    still = np.tile(_warp(np.eye(2)), (6, 1, 1))
    other = align(patches, _eight_bits(field(column + 300, row + 170)), nodes, still, np.ones(6, bool), 4.0)
    negative = align(patches, 255 - image, nodes, still, np.ones(6, bool), 4.0)
    flat = align(patches, np.full_like(image, 90), nodes, still, np.ones(6, bool), 4.0)
    assert other.score.max() < 0.6 and negative.score.max() <= 0.0 and flat.score.max() < 0.3
    half = np.array([True, False] * 3)
    assert (align(patches, image, nodes, still, half, 4.0).score[~half] == 0.0).all()


def test_a_node_at_the_silhouette_ignores_what_passes_behind(field):
    column, row = np.meshgrid(np.arange(150.0), np.arange(110.0))
    nodes = np.array([[40.0, 40.0], [80.0, 40.0], [80.0, 75.0], [40.0, 75.0]])
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    cells = grid_cells(edges, 4)
    assert len(cells) == 1
    inside = silhouette((110, 150), nodes, cells, 1)
    body, shift = inside > 0, np.array([2.0, -1.0])
    first = np.where(cv2.dilate(inside, np.ones((3, 3))) > 0, field(column, row), field(column + 400, row))
    rolled = np.roll(cv2.dilate(inside, np.ones((3, 3))), (-1, 2), (0, 1)) > 0
    then = np.where(rolled, field(column - shift[0], row - shift[1]), field(column + 900, row))
    still, everyone = np.tile(_warp(np.eye(2)), (4, 1, 1)), np.ones(4, bool)
    masked, plain = (
        align(reference_patches(_eight_bits(first), nodes, mask, 0, 21), _eight_bits(then), nodes, still, everyone, 4.0)
        for mask in (inside, np.ones_like(inside))
    )
    assert body.sum() > 1000
    assert np.abs(masked.pixels - nodes - shift).max() < 0.05 and masked.score.min() > 0.99
    assert plain.score.max() < 0.9


@pytest.fixture
def grid():
    nodes = np.stack([g.ravel() for g in np.meshgrid(np.arange(7) * 30.0, np.arange(4) * 30.0, indexing="ij")], axis=1)
    return neighbourhoods(nodes, lattice_edges(7, 4))


def test_neighbours_agree_on_an_affine_motion_against_outliers(grid):
    field = grid.pixels @ np.array([[0.1, 0.2], [-0.3, 0.05]]) + [3.0, -2.0]
    wrong = field.copy()
    wrong[[5, 17]] += [25.0, -40.0]
    everyone = np.ones(28, bool)
    assert np.abs(smooth_locally(grid, field, everyone) - field).max() < 0.01
    assert np.abs(smooth_locally(grid, wrong, everyone) - field).max() < 2.0
    some = everyone.copy()
    some[[5, 17]] = False
    assert np.abs(smooth_locally(grid, wrong, some) - field).max() < 0.01
    assert (smooth_locally(grid, field, ~everyone) == 0.0).all()
    assert np.allclose(grid.pitch, 30.0)


def test_bending_is_warped_and_filled_in_exactly(grid):
    """A quadratic motion: slopes, curvatures and the nodes that nobody sees follow from the others."""
    x, y = grid.pixels.T
    field = np.stack([2.0 - 3e-3 * x * y, 1.0 + 1.5e-3 * x * x + 0.1 * y], axis=1)
    rows = warp_operator(grid) @ field
    assert np.allclose(rows[0], np.stack([-3e-3 * y, 3e-3 * x], axis=1), atol=0.02)
    assert np.allclose(rows[1], np.stack([-3e-3 * x, np.full(28, 0.1)], axis=1), atol=0.02)
    assert np.allclose(rows[2, :, 1], 1.5e-3, atol=2e-4) and np.allclose(rows[3, :, 0], -3e-3, atol=4e-4)
    known = np.ones((7, 4), bool)
    known[2:4] = False
    filled = fill(grid, field, known.ravel())
    assert np.abs(filled - field).max() < 0.6 and (filled[known.ravel()] == field[known.ravel()]).all()
    assert np.abs(field).max() > 30.0


def test_a_part_that_sits_one_pitch_off_is_found(grid):
    everyone, shifted = np.ones(28, bool), grid.pixels.copy()
    assert not torn_off(grid, shifted, grid.pixels, everyone).any()
    shifted[20:] += [30.0, 0.0]
    assert np.array_equal(torn_off(grid, shifted, grid.pixels, everyone), np.arange(28) >= 20)


def test_cells_of_a_grid_with_a_hole():
    edges = lattice_edges(4, 4)
    assert len(grid_cells(edges, 16)) == 9
    kept = edges[(edges != 5).all(axis=1)]
    assert len(grid_cells(kept, 16)) == 5
    assert len(grid_cells(np.array([[0, 1], [1, 2]]), 3)) == 0
