"""A free surface over a polar grid ends on the wall and encloses the volume that it should."""

import numpy as np
import pytest

from zsdt.fluid.families import draw_shape
from zsdt.fluid.sampling import fill
from zsdt.fluid.vessel import Vessel
from zsdt.lab.glass_surface import ParticleSurface, VolumeBelow, polar_heights, surface_points, wall_radius
from zsdt.scene import VesselFamily, VesselShape

FAMILIES = list(VesselFamily)


def vessel_of(family):
    return draw_shape(family, 0.04, 0.05, 0.05, np.random.default_rng(4))


@pytest.mark.parametrize("family", FAMILIES)
def test_the_contact_line_is_on_the_wall_and_on_the_surface(family) -> None:
    shape = vessel_of(family)

    def surface(at):
        return 0.05 + 0.3 * at[:, 0] - 0.1 * at[:, 1]

    points = surface_points(shape, polar_heights(shape, surface))
    contact = points[-1]
    np.testing.assert_allclose(contact[:, 2], surface(contact[:, :2]), atol=1e-9)
    assert np.abs(Vessel(shape).distance(contact)).max() < 2e-5  # a superellipse is a polygon there
    inner = points[1:-1].reshape(-1, 3)
    np.testing.assert_allclose(inner[:, 2], surface(inner[:, :2]), atol=1e-9)
    angle = np.arctan2(contact[:, 1], contact[:, 0])
    np.testing.assert_allclose(wall_radius(shape, angle, contact[:, 2]), np.hypot(*contact[:, :2].T), rtol=1e-9)


def test_liquid_under_the_shoulder_of_a_flask_has_no_surface_there() -> None:
    """What a surface is thought to be beyond its first meeting with the wall does not count."""
    shape = vessel_of(VesselFamily.flask)

    def surface(at):  # rises into the shoulder at one side and falls to nothing beyond it
        return np.where(at[:, 0] < -0.037, 0.0, 0.05 - 0.6 * at[:, 0])

    height = polar_heights(shape, surface)
    contact = surface_points(shape, height)[-1]
    np.testing.assert_allclose(contact[:, 2], 0.05 - 0.6 * contact[:, 0], atol=1e-6)
    assert contact[:, 2].max() > max(
        z for z, r in zip(shape.heights, shape.radii, strict=True) if r == max(shape.radii)
    )
    assert (Vessel(shape).distance(surface_points(shape, height)[1:-1].reshape(-1, 3)) > 0).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_volume_below_a_level_is_that_of_the_vessel(family) -> None:
    shape = vessel_of(family)
    below = VolumeBelow(shape)
    for level in (0.02, 0.05, 0.07):
        height = polar_heights(shape, lambda at, level=level: np.full(len(at), level))
        assert below(height) == pytest.approx(Vessel(shape).volume(level), rel=0.006)


def test_a_tilt_keeps_the_volume_of_a_cylinder() -> None:
    shape = vessel_of(VesselFamily.cylinder)
    below = VolumeBelow(shape)
    tilted = below(polar_heights(shape, lambda at: 0.05 + 0.6 * at[:, 0]))
    assert tilted == pytest.approx(below(polar_heights(shape, lambda at: np.full(len(at), 0.05))), rel=1e-3)


@pytest.mark.parametrize("family", [VesselFamily.tumbler, VesselFamily.bowl, VesselFamily.jar])
def test_particles_tell_the_surface(family) -> None:
    shape, spacing = vessel_of(family), 0.004
    vessel = Vessel(shape)
    low, high = vessel.bounds()
    axes = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def surface(at):
        return 0.05 + 0.25 * at[:, 0]

    particles = lattice[(vessel.distance(lattice) > 0.5 * spacing) & (lattice[:, 2] < surface(lattice))]
    truth = polar_heights(shape, surface)
    volume = VolumeBelow(shape)(truth)
    found = ParticleSurface(shape, (volume / len(particles)) ** (1 / 3), volume).measure(particles)
    assert found.shape == truth.shape
    assert VolumeBelow(shape)(found) == pytest.approx(volume, rel=1e-3)
    assert np.sqrt(np.mean((found - truth) ** 2)) < 0.25 * spacing
    assert np.abs(found - truth).max() < 0.75 * spacing


def test_columns_that_end_in_a_narrowing_wall_do_not_pull_the_surface_down() -> None:
    """A tall bowl, filled above its widest place: beside the surface there are columns full up to the wall."""
    heights = [0.0, 0.006, 0.0143, 0.0241, 0.031, 0.0484, 0.0657, 0.0831, 0.1005, 0.1178, 0.1265]
    radii = [0.0142, 0.0218, 0.0275, 0.0308, 0.0314, 0.0311, 0.0303, 0.0289, 0.027, 0.0245, 0.023]
    level, vessel = 0.0735, Vessel(VesselShape(VesselFamily.bowl, heights, radii))
    filling = fill(vessel, level, 1200, np.random.default_rng(0))
    surface = ParticleSurface(vessel.shape, filling.spacing, vessel.volume(level))
    surface.calibrate(filling.points)
    measured = surface.measure(filling.points)
    assert np.ptp(measured) < 0.0005
    assert measured.mean() == pytest.approx(level, abs=0.0003)
