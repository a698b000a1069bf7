"""Sloshing modes of any vessel: closed forms of cylinder and tank, walls that let nothing through, no divergence."""

import numpy as np
import pytest
from scipy.special import jnp_zeros

from zsdt.errors import OptionError
from zsdt.fluid.families import draw_shape
from zsdt.fluid.linear_theory import cylinder_modes, tank_modes
from zsdt.fluid.slosh_modes import slosh_modes
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily, VesselShape

RADIUS = 0.035


def cylinder(radius=RADIUS, rim=0.15):
    return VesselShape(VesselFamily.cylinder, [0.0, rim], [radius, radius])


@pytest.mark.parametrize("depth", [0.03, 0.07])
def test_frequencies_of_a_cylinder(depth):
    modes = slosh_modes(cylinder(), depth, 5)
    wavenumber = np.sort(np.concatenate([jnp_zeros(order, 2) for order in range(6)]))[:5] / RADIUS
    exact = wavenumber * np.tanh(wavenumber * depth)
    np.testing.assert_allclose(modes.stiffness[:4], exact[:4], rtol=2e-4)
    assert modes.frequency()[0] == pytest.approx(cylinder_modes(RADIUS, depth).frequency()[0], rel=1e-9)
    assert modes.norm[0] == pytest.approx(np.pi * RADIUS**2 * cylinder_modes(RADIUS, depth).norm[0], rel=2e-3)


def test_first_frequency_of_a_nearly_rectangular_tank():
    tank = VesselShape(VesselFamily.jar, [0.0, 0.12], [RADIUS, RADIUS], aspect=0.7, exponent=40.0)
    assert slosh_modes(tank, 0.06, 1).frequency()[0] == pytest.approx(
        tank_modes(2 * RADIUS, 0.06).frequency()[0], rel=2e-3
    )


@pytest.mark.parametrize("family", list(VesselFamily))
def test_walls_let_nothing_through_and_nothing_is_compressed(family):
    level = 0.05
    shape = draw_shape(family, 0.034, level, 0.05, np.random.default_rng(5))
    modes, vessel = slosh_modes(shape, level, 3), Vessel(shape)
    assert (np.diff(modes.stiffness) > 0).all()
    rng = np.random.default_rng(0)
    box = rng.uniform(-1.0, 1.0, (4000, 3)) * [0.045, 0.045, 0.5 * level] + [0.0, 0.0, 0.5 * level]
    inside = box[vessel.distance(box) > 0.002][:200]
    gradient = modes.at(inside)[1]
    step = 1e-6
    divergence = sum(
        (modes.at(inside + step * np.eye(3)[a])[1] - modes.at(inside - step * np.eye(3)[a])[1])[:, a] / (2 * step)
        for a in range(3)
    )
    assert np.abs(divergence).max() < 1e-4 * np.abs(gradient).max() / RADIUS
    near = box[np.abs(vessel.distance(box)) < 0.01]
    distance, normal = vessel.distance_and_normal(near)
    wall = near - distance[:, None] * normal
    flux = np.abs(np.einsum("ni,nik->nk", vessel.distance_and_normal(wall)[1], modes.at(wall)[1]))
    # Corners of the profile are where smooth functions give way a little.
    assert (np.sqrt((flux**2).mean(axis=0)) < 0.1 * np.sqrt((gradient**2).sum(axis=1).mean(axis=0))).all()


def test_impossible_requests_are_refused():
    with pytest.raises(OptionError, match="positive level"):
        slosh_modes(cylinder(), 0.0, 2)
    with pytest.raises(OptionError, match="higher degree"):
        slosh_modes(cylinder(), 0.05, 20, degree=4)
