"""The surface of a heap of particles is found to a fraction of their spacing."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.fluid.free_surface import FreeSurface
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily, VesselShape

SPACING, LEVEL = 0.006, 0.06


def heap(vessel, slope, rng):
    """Particles of a turned lattice with some disorder, below `z = level + slope x` in the vessel."""
    ticks = np.arange(-0.17, 0.17, SPACING)
    points = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    points = points @ turn.T + rng.normal(0.0, 0.1 * SPACING, points.shape) + [0.0, 0.0, 0.06]
    points = points[vessel.distance(points) > 0]
    return points[points[:, 2] < LEVEL + slope * points[:, 0]]


@pytest.mark.parametrize(
    "vessel",
    [
        Vessel(VesselShape(heights=[0.0, 0.14], radii=[0.045, 0.045])),
        Vessel(VesselShape(VesselFamily.jar, [0.0, 0.14], [0.045, 0.045], aspect=0.7, exponent=8.0)),
    ],
)
@pytest.mark.parametrize("slope", [0.0, 0.4, 0.8])
def test_highest_point_of_a_tilted_plane(vessel, slope):
    surface = FreeSurface(vessel, SPACING, LEVEL)
    rng = np.random.default_rng(3)
    error = [surface.highest(heap(vessel, slope, rng)) - LEVEL - 0.045 * slope for _ in range(4)]
    assert abs(np.mean(error)) < 0.25 * SPACING
    assert np.std(error) < 0.35 * SPACING


def test_a_drop_and_a_dry_floor_are_no_surface():
    vessel = Vessel(VesselShape(heights=[0.0, 0.14], radii=[0.045, 0.045]))
    surface = FreeSurface(vessel, SPACING, LEVEL)
    drop = np.array([[0.01, 0.0, 0.12]])
    assert surface.highest(drop) == pytest.approx(0.0, abs=1e-12)
    liquid = heap(vessel, 0.0, np.random.default_rng(0))
    assert surface.highest(np.concatenate([liquid, drop])) == surface.highest(liquid)


def test_heights_at_places_follow_the_slope():
    vessel = Vessel(VesselShape(heights=[0.0, 0.14], radii=[0.045, 0.045]))
    surface = FreeSurface(vessel, SPACING, LEVEL)
    liquid = heap(vessel, 0.5, np.random.default_rng(1))
    places = np.array([[-0.03, 0.0], [0.0, 0.0], [0.03, 0.0]])
    np.testing.assert_allclose(surface.at(liquid, places), [0.045, 0.06, 0.075], atol=0.2 * SPACING)


def test_a_vessel_narrower_than_the_spacing_is_refused():
    with pytest.raises(OptionError, match="narrow"):
        FreeSurface(Vessel(VesselShape(heights=[0.0, 0.1], radii=[0.025, 0.025])), 1e9, LEVEL, degree=20)
