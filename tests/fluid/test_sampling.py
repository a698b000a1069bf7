"""Packed particles: distances between them, inside the vessel, even in the eyes of the kernel."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from zsdt.errors import OptionError, RunRejected
from zsdt.fluid.families import draw_shape
from zsdt.fluid.sampling import Packer, fill, poisson_disk, spacing_of
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily, VesselShape

CYLINDER = Vessel(VesselShape(heights=[0.0, 0.1], radii=[0.035, 0.035]))


def nearest(points):
    return cKDTree(points).query(points, k=2)[0][:, 1]


def test_disks_do_not_touch_and_fill_the_cavity():
    radius = 0.006
    points = poisson_disk(CYLINDER, 0.05, radius, 0.0015, np.random.default_rng(0))
    assert nearest(points).min() >= radius
    assert CYLINDER.distance(points).min() > 0.0015 and points[:, 2].max() < 0.05 - 0.0015
    # Maximal: hardly a place is left where another would fit (the share of volume farther than the radius is small).
    trial = poisson_disk(CYLINDER, 0.05, 0.004, 0.0015, np.random.default_rng(1))
    assert (cKDTree(points).query(trial)[0] > radius).mean() < 0.03
    # Effective spacing of disks of radius r is ~1.2 r (DESIGN 3.2).
    assert spacing_of(CYLINDER.volume(0.05), len(points)) / radius == pytest.approx(1.19, abs=0.05)


@pytest.mark.parametrize("family", [VesselFamily.bowl, VesselFamily.jar], ids=lambda f: f.value)
def test_packing_spreads_particles_evenly(family):
    rng = np.random.default_rng(3)
    vessel = Vessel(draw_shape(family, 0.04, 0.05, 0.06, rng))
    filled = fill(vessel, 0.05, 500, rng)
    points, spacing = filled.points, filled.spacing
    assert len(points) == pytest.approx(500, rel=0.08)
    assert len(points) * spacing**3 == pytest.approx(vessel.volume(0.05), rel=1e-12)
    between = nearest(points) / spacing
    assert between.min() > 0.55 and between.std() < 0.1 and 0.9 < between.mean() < 1.0
    assert vessel.distance(points).min() > 0.29 * spacing
    assert points[:, 2].max() <= 0.05 - 0.3 * spacing + 1e-12


def test_packing_lowers_the_unevenness_that_it_measures():
    rng = np.random.default_rng(5)
    level = 0.05
    start = poisson_disk(CYLINDER, level, 0.006, 0.0015, rng)
    packer = Packer(CYLINDER, level, spacing_of(CYLINDER.volume(level), len(start)))
    before = np.linalg.norm(packer.unevenness(start), axis=1).mean()
    packed = packer.pack(start)
    assert np.linalg.norm(packer.unevenness(packed), axis=1).mean() < 0.3 * before
    np.testing.assert_array_equal(packer.pack(start), packed)
    assert nearest(packed).mean() > nearest(start).mean()


def test_impossible_fillings_are_refused():
    with pytest.raises(OptionError, match="must be positive"):
        spacing_of(1e-4, 0)
    thin = Vessel(VesselShape(heights=[0.0, 0.1], radii=[0.001, 0.001]))
    with pytest.raises(RunRejected, match="find a place") as error:
        fill(thin, 0.05, 1, np.random.default_rng(0))
    assert error.value.cause == "packing"
