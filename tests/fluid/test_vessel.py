"""Vessels: distance against brute force, normals against differences, volumes against closed forms, the table."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from zsdt.errors import OptionError
from zsdt.fluid.distance_grid import DistanceGrid
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily, VesselShape

CYLINDER = VesselShape(VesselFamily.cylinder, [0.0, 0.1], [0.035, 0.035])
TUMBLER = VesselShape(VesselFamily.tumbler, [0.0, 0.1], [0.028, 0.042])
FLASK = VesselShape(VesselFamily.flask, [0.0, 0.05, 0.065, 0.12], [0.04, 0.04, 0.02, 0.02])
JAR = VesselShape(VesselFamily.jar, [0.0, 0.1], [0.04, 0.04], aspect=0.7, exponent=4.0)
SHAPES = pytest.mark.parametrize("shape", [CYLINDER, TUMBLER, FLASK, JAR], ids=lambda s: s.family.value)


def wall_cloud(shape, step=5e-4):
    """Points all over floor and wall (up to 3 cm above the rim), and how far apart they are at most."""
    angle = np.arange(0, 2 * math.pi, step / max(shape.radii))
    power = 2.0 / shape.exponent
    unit = np.stack([np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power,
                     shape.aspect * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power], axis=1)  # fmt: skip
    if shape.exponent > 2:  # even steps: this way of drawing a superellipse crowds its flat sides
        dense = np.arange(0, 2 * math.pi, 2e-5)
        ring = np.stack([np.cos(dense), np.sin(dense)], axis=1)
        reach = (np.abs(ring[:, 0]) ** shape.exponent + np.abs(ring[:, 1] / shape.aspect) ** shape.exponent) ** (
            -1 / shape.exponent
        )
        unit = (ring * reach[:, None])[:: max(1, int(step / max(shape.radii) / 2e-5 / 1.5))]
    heights = np.arange(0, shape.rim + 0.03, step)
    radii = np.interp(heights, shape.heights, shape.radii)
    walls = [np.column_stack([r * unit, np.full(len(unit), z)]) for r, z in zip(radii, heights, strict=True)]
    floor = [np.column_stack([r * unit, np.zeros(len(unit))]) for r in np.arange(0, shape.radii[0], step)]
    return np.concatenate(walls + floor)


def some_points(shape, count=1500, seed=0):
    rng = np.random.default_rng(seed)
    low, high = Vessel(shape).bounds()
    return low - 0.01 + rng.random((count, 3)) * (high - low + 0.02)


@SHAPES
def test_distance_is_that_to_the_nearest_point_of_the_wall(shape):
    points = some_points(shape)
    nearest, _ = cKDTree(wall_cloud(shape)).query(points)
    distance = Vessel(shape).distance(points)
    far = nearest > 2e-3  # there, a wall of points 0.5 mm apart is as good as the wall
    np.testing.assert_allclose(np.abs(distance[far]), nearest[far], atol=5e-5)
    assert np.abs(distance[~far]).max() <= 2e-3 + 1e-9
    x, y, z = points.T
    radius = np.interp(z, shape.heights, shape.radii)
    inside = (np.abs(x / radius) ** shape.exponent + np.abs(y / radius / shape.aspect) ** shape.exponent < 1) & (z > 0)
    clear = np.abs(distance) > 1e-5
    np.testing.assert_array_equal((distance > 0)[clear], inside[clear])


@SHAPES
def test_normal_is_the_gradient_of_the_distance(shape):
    vessel = Vessel(shape)
    points = some_points(shape, seed=1)
    distance, normal = vessel.distance_and_normal(points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    step = 1e-7
    differences = np.stack(
        [(vessel.distance(points + step * e) - vessel.distance(points - step * e)) / (2 * step) for e in np.eye(3)],
        axis=1,
    )
    good = np.linalg.norm(differences - normal, axis=1) < 1e-4
    assert good.mean() > 0.995  # the rest lie on ridges, where two pieces of wall are equally near
    # Walking back along the normal ends on the wall.
    ends = vessel.distance(points - distance[:, None] * normal)
    np.testing.assert_allclose(ends, 0.0, atol=1e-9)


def test_normals_on_the_wall_point_inwards():
    points = np.array([[0.0, 0.0, 0.0], [0.035, 0.0, 0.05], [0.0, -0.035, 0.05]])
    distance, normal = Vessel(CYLINDER).distance_and_normal(points)
    np.testing.assert_allclose(distance, 0.0, atol=1e-15)
    np.testing.assert_allclose(normal, [[0, 0, 1], [-1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_volumes_of_closed_forms():
    assert Vessel(CYLINDER).volume(0.05) == pytest.approx(math.pi * 0.035**2 * 0.05, rel=1e-14)
    top = 0.028 + 0.014 * 0.5
    assert Vessel(TUMBLER).volume(0.05) == pytest.approx(
        math.pi / 3 * 0.05 * (0.028**2 + 0.028 * top + top**2), rel=1e-14
    )
    flask = Vessel(FLASK)
    cone = math.pi / 3 * 0.015 * (0.04**2 + 0.04 * 0.02 + 0.02**2)
    assert flask.volume(0.08) == pytest.approx(math.pi * (0.04**2 * 0.05 + 0.02**2 * 0.015) + cone, rel=1e-14)
    assert flask.volume(0.14) == pytest.approx(flask.volume(0.12) + math.pi * 0.02**2 * 0.02, rel=1e-12)
    area = 4 * 0.04 * 0.028 * math.gamma(1.25) ** 2 / math.gamma(1.5)
    assert Vessel(JAR).volume(0.05) == pytest.approx(area * 0.05, rel=3e-5)


@SHAPES
def test_level_undoes_volume(shape):
    vessel = Vessel(shape)
    for level in (0.0, 0.01, 0.055, 0.0999, 0.15):
        assert vessel.level(vessel.volume(level)) == pytest.approx(level, abs=1e-12)
    with pytest.raises(OptionError, match="negative volume"):
        vessel.level(-1e-9)


@SHAPES
def test_volume_agrees_with_the_distance(shape):
    """Share of random points inside, of the box up to a level, against the closed form."""
    vessel, level = Vessel(shape), 0.07
    low, high = vessel.bounds()
    high = np.array([high[0], high[1], level])
    points = low + np.random.default_rng(2).random((40000, 3)) * (high - low)
    share = (vessel.distance(points) > 0).mean() * np.prod(high - low)
    assert share == pytest.approx(vessel.volume(level), rel=0.012)


@SHAPES
def test_table_is_the_distance_within_its_error(shape):
    vessel = Vessel(shape)
    spacing = 1.5e-3
    grid = DistanceGrid(vessel, spacing)
    points = some_points(shape, seed=3)
    distance, normal = grid.lookup(points)
    exact, exact_normal = vessel.distance_and_normal(points)
    error = np.abs(distance - exact)
    assert error.max() < 0.5 * spacing and np.median(error) < 1e-5
    near = (exact > 0) & (exact < 0.005)
    assert np.median(np.linalg.norm(normal - exact_normal, axis=1)[near]) < 0.02
    mirrored = grid.lookup(points * [-1, 1, 1])[0]
    np.testing.assert_allclose(mirrored, distance, atol=1e-12)


def test_table_goes_on_beyond_its_edge():
    grid = DistanceGrid(Vessel(CYLINDER), 2e-3)
    far = np.array([[0.3, 0.0, 0.05], [0.0, 0.0, -0.2], [0.0, 0.0, 0.5]])
    distance, _ = grid.lookup(far)
    np.testing.assert_allclose(distance, [0.035 - 0.3, -0.2, 0.035], atol=1.5e-3)
    with pytest.raises(OptionError, match="must be positive"):
        DistanceGrid(Vessel(CYLINDER), 0.0)
