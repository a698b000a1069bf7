"""Edges of masks: sub-pixel on exact covers, specks and gaps forgiven, honest where there is nothing."""

import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.perception.mask_edges import read_edges


def box(left: float, right: float, top: float, bottom: float, size: tuple[int, int] = (60, 50)) -> np.ndarray:
    """Exact cover of an upright rectangle, 0..1."""
    width, height = size
    u, v = np.arange(width), np.arange(height)
    across = np.clip(np.minimum(u + 0.5, right) - np.maximum(u - 0.5, left), 0.0, 1.0)
    down = np.clip(np.minimum(v + 0.5, bottom) - np.maximum(v - 0.5, top), 0.0, 1.0)
    return np.outer(down, across).astype(np.float32)


def test_edges_of_exact_covers_are_found_to_a_tenth_of_a_pixel() -> None:
    for shift in np.linspace(0.0, 0.9, 7):
        glass, liquid = box(10.2 + shift, 40.7 + shift, 5.3, 44.1), box(10.2 + shift, 40.7 + shift, 20.6 + shift, 44.1)
        edges = read_edges(glass, liquid)
        rows, columns = slice(8, 40), slice(15, 38)
        assert np.allclose(edges.left[rows], 10.2 + shift, atol=0.1)
        assert np.allclose(edges.right[rows], 40.7 + shift, atol=0.1)
        assert np.allclose(edges.top[columns], 5.3, atol=0.1) and np.allclose(edges.bottom[columns], 44.1, atol=0.1)
        assert np.allclose(edges.surface[columns], 20.6 + shift, atol=0.1)


def test_bytes_and_probabilities_and_windows_say_the_same() -> None:
    glass, liquid = box(10.2, 40.7, 5.3, 44.1), box(10.2, 40.7, 20.6, 44.1)
    whole = read_edges(glass, liquid)
    covers = read_edges(np.rint(255 * glass).astype(np.uint8), np.rint(255 * liquid).astype(np.uint8))
    part = read_edges(glass[3:, 7:], liquid[3:, 7:], (7, 3), (60, 50))
    assert np.nanmax(np.abs(whole.left - covers.left)) < 0.01
    assert np.allclose(whole.left[3:], part.left, equal_nan=True)
    assert np.allclose(whole.surface[7:], part.surface, equal_nan=True) and part.size == (60, 50)


def test_a_drop_on_the_wall_is_not_the_surface_and_a_thin_flash_is_no_gap() -> None:
    glass, liquid = box(10, 40, 5, 44), box(10, 40, 20, 44)
    liquid[8:13, 20:25] = 1.0  # a drop
    liquid[26:28, 28:33] = 0.0  # a flash, thin
    edges = read_edges(glass, liquid)
    assert np.allclose(edges.surface[12:39], 20.0, atol=0.51)
    assert np.all(edges.depth[28:33] > 15)


def test_nothing_and_a_cut_off_glass() -> None:
    nothing = np.zeros((50, 60), np.float32)
    edges = read_edges(nothing, nothing)
    assert not edges.has_glass and not edges.has_liquid
    glass = box(-5, 30, 5, 44)
    assert read_edges(glass, nothing).touches("left") and not read_edges(glass, nothing).touches("right")
    with pytest.raises(DataError, match="one size and kind"):
        read_edges(glass, nothing.astype(np.uint8))
