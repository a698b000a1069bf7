"""Surfaces of particles: known tilts, the volume that they hold, vessels whose wall leans over the liquid."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.fluid.families import draw_shape
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily, VesselShape
from zsdt.twin.glass_levels import LevelReader
from zsdt.twin.seen_surface import leans_over

SPACING = 0.004
SHAPE = VesselShape(VesselFamily.cylinder, [0.0, 0.1], [0.03, 0.03])


def lattice(shape, height):
    """Particles of a cubic lattice in a vessel below heights over (x, y)."""
    steps = np.arange(-0.05 + 0.5 * SPACING, 0.05, SPACING)
    grid = np.stack(np.meshgrid(steps, steps, np.arange(0.5 * SPACING, 0.1, SPACING), indexing="ij"), -1).reshape(-1, 3)
    inside = Vessel(shape).distance(grid) > 0.2 * SPACING
    return grid[inside & (grid[:, 2] < height(grid[:, 0], grid[:, 1]))]


def test_a_tilted_surface_is_read_where_it_is():
    reader = LevelReader(SHAPE, SPACING)
    points = lattice(SHAPE, lambda x, y: 0.05 + 0.3 * x)
    found = reader.fit(points)
    places = np.array([[-0.02, 0.0], [0.0, 0.0], [0.02, 0.0], [0.01, 0.02]])
    np.testing.assert_allclose(reader.at(found, places), 0.05 + 0.3 * places[:, 0], atol=0.4 * SPACING)
    slope = reader.slopes(places) @ found
    np.testing.assert_allclose(slope[:, 0], 0.3, atol=0.06)
    step = 1e-6
    numeric = (reader.at(found, places + np.array([step, 0.0])) - reader.at(found, places - np.array([step, 0.0]))) / (
        2 * step
    )
    np.testing.assert_allclose(slope[:, 0], numeric, rtol=1e-5)


@pytest.mark.parametrize("family", list(VesselFamily))
def test_a_level_surface_holds_what_the_vessel_holds(family):
    shape = draw_shape(family, 0.034, 0.05, 0.05, np.random.default_rng(4))
    reader, vessel = LevelReader(shape, SPACING), Vessel(shape)
    level = np.zeros(len(reader.powers))
    for height in (0.025, 0.05):
        level[0] = height
        assert reader.volume(level)[0] == pytest.approx(vessel.volume(height), rel=5e-3)
        shifted = reader.holding(level + np.eye(len(level))[0] * 0.003, vessel.volume(height))
        assert shifted[0] == pytest.approx(height, abs=3e-4)


def test_walls_that_lean_over_the_liquid_hide_its_surface():
    flask = VesselShape(VesselFamily.flask, [0.0, 0.05, 0.07, 0.1], [0.03, 0.03, 0.016, 0.016])
    np.testing.assert_array_equal(leans_over(flask, np.array([0.03, 0.06, 0.08])), [False, True, False])
    assert not leans_over(SHAPE, np.array([0.02, 0.09])).any()


def test_too_few_columns_are_refused():
    with pytest.raises(OptionError, match="narrow"):
        LevelReader(SHAPE, SPACING, degree=16)
