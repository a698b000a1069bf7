"""The measure of the glass twin must not find errors that are its own."""

from dataclasses import replace

import numpy as np
import pytest

from tests.twin.made_up_glass import LEVEL, PITCH, RADIUS, made_up_glass
from zsdt.twin.glass_errors import (
    Between,
    error_and_floor,
    error_curves,
    spline_at,
    velocity_at,
    vertical_error,
    vertical_velocity_rrmse,
)


def sloshing(points):
    """Velocity [m/s] of the first mode over a flat floor: harmonic, and free of divergence."""
    k = 0.5 * np.pi / RADIUS
    x, z = k * points[..., 0], k * points[..., 2]
    up = np.sin(x) * np.sinh(z)
    return 0.1 * np.stack([np.cos(x) * np.cosh(z), np.zeros_like(up), up], axis=-1) / np.sinh(k * LEVEL)


def in_the_glass(count, seed):
    """Particles that no lattice orders, as a liquid's."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-RADIUS, -RADIUS, 0.0], [RADIUS, RADIUS, LEVEL], (8 * count, 3))
    points = points[np.hypot(points[:, 0], points[:, 1]) < RADIUS]
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(np.array(kept) - point, axis=1).min() > 0.8 * PITCH and len(kept) < count:
            kept.append(point)
    return np.array(kept)


@pytest.fixture(scope="module")
def sides():
    """A truth, and a twin whose other, fewer particles move exactly as it does."""
    _, _, truth = made_up_glass()
    few = range(3)
    ours, theirs = in_the_glass(500, 1), in_the_glass(900, 2)

    def side(points):
        positions = np.repeat(points[None], len(few), axis=0)
        cut = slice(0, truth.start + len(few))
        fields = {"velocity": sloshing(positions)}
        body = replace(truth.body, points=points, clamped=np.zeros(len(points), bool), mass=np.full(len(points), 1e-3))
        return replace(
            truth, body=body, frames=truth.frames[cut], times=truth.times[cut], origin=truth.origin[cut],
            positions=positions, level=truth.level[: len(few)], predicted_level=None, seen_level=None, seen_px=None,
            outlines=[], faults=[], phases=[], fields=fields, account={}, latency={},
        )  # fmt: skip

    return side(ours), side(theirs)


def test_a_linear_flow_is_told_exactly_between_particles():
    points, other = in_the_glass(200, 3), in_the_glass(100, 4)
    slope = np.array([[1.0, -2.0, 0.5], [0.3, 1.0, 0.0], [0.0, 0.7, -2.0]])
    assert np.abs(spline_at(points, points @ slope + 0.2, other) - (other @ slope + 0.2)).max() < 1e-9


def test_a_perfect_twin_is_within_a_few_percent_and_a_mean_of_near_particles_is_not(sides):
    view, truth = sides
    assert vertical_velocity_rrmse(view, truth) < 0.03
    assert vertical_velocity_rrmse(view, truth, Between.near_mean) > 0.08
    assert error_curves(view, truth)["vertical_velocity"].max() < 0.03


def test_the_floor_is_what_a_perfect_twin_scores(sides):
    view, truth = sides
    error, floor = error_and_floor(view, truth)
    assert np.allclose(error, vertical_error(view, truth), rtol=1e-9)
    assert 0.5 * error.mean() < floor.mean() < 2.0 * error.mean()
    assert np.max(error_and_floor(truth, truth)) < 1e-9


def test_a_twin_that_is_slower_by_a_fifth_is_off_by_a_fifth(sides):
    view, truth = sides
    slow = replace(view, fields={"velocity": 0.8 * view.fields["velocity"]})
    assert vertical_velocity_rrmse(slow, truth) == pytest.approx(0.2, abs=0.01)
    assert np.allclose(velocity_at(slow, 0, view.positions[0]), 0.8 * view.fields["velocity"][0], atol=1e-9)
