"""Linear theory against closed forms and published values."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.fluid.linear_theory import (
    cylinder_modes,
    forced_response,
    highest_at_wall,
    tank_modes,
    tank_shapes,
    torsional_decay_rate,
    torsional_velocity,
    wall_damping_ratio,
)

UPRIGHT = np.array([0.0, 0.0, 9.81])


def test_frequencies_of_the_glass_on_the_robot_and_of_a_published_tank():
    assert cylinder_modes(0.049, 0.08).frequency()[0] == pytest.approx(3.05, abs=0.01)
    # Faltinsen et al. 2000: 1.73 m long, 0.6 m deep, natural period 1.66 s
    assert 1.0 / tank_modes(1.73, 0.6).frequency()[0] == pytest.approx(1.66, abs=0.01)


@pytest.mark.parametrize("modes", [cylinder_modes(0.05, 1e-6, 2000), tank_modes(0.1, 1e-6, 2000)])
def test_weights_are_those_of_x_and_shallow_liquid_loses_nothing(modes):
    assert modes.weight.sum() == pytest.approx(0.05, rel=1e-3)
    assert modes.kinetic_share_after_stop == pytest.approx(1.0, rel=1e-3)


def test_kinetic_energy_left_by_a_sudden_stop():
    assert cylinder_modes(0.035, 0.05, 40).kinetic_share_after_stop == pytest.approx(0.328, abs=1e-3)


@pytest.mark.parametrize("make", [cylinder_modes, tank_modes])
def test_equivalent_mass_sits_under_the_surface_and_high_in_deep_liquid(make):
    shallow, deep = make(0.05, 0.01, 1).mass_height[0], make(0.05, 1.0, 1).mass_height[0]
    assert abs(shallow) < 0.01
    assert deep == pytest.approx(1.0 - 2.0 / make(0.05, 1.0, 1).wavenumber[0])


def test_a_steady_push_tilts_the_surface_to_its_static_slope():
    modes = cylinder_modes(0.049, 0.08, 40)
    times = np.arange(0.0, 8.0, 0.002)
    force = np.tile(UPRIGHT, (len(times), 1))
    force[:, 0] = 0.5 * np.clip(times / 2.0, 0.0, 1.0)
    height = forced_response(modes, times, force, damping=0.2)
    assert height[-1, :, 0].sum() == pytest.approx(-0.5 / 9.81 * modes.weight.sum(), rel=1e-3)
    assert highest_at_wall(height)[-1] == pytest.approx(0.5 / 9.81 * 0.049, rel=0.03)


def test_free_swing_keeps_frequency_and_amplitude():
    modes = cylinder_modes(0.049, 0.08, 1)
    period = 1.0 / modes.frequency()[0]
    times = np.linspace(0.0, 10.0 * period, 5001)
    force = np.tile(UPRIGHT, (len(times), 1))
    force[times < 0.5 * period, 1] = 0.3  # a push of half a period leaves twice the static height swinging
    height = forced_response(modes, times, force)[:, 0, 1]
    static = 0.3 / 9.81 * modes.weight[0]
    late = times > 1.0 * period
    assert np.abs(height[late]).max() == pytest.approx(2.0 * static, rel=1e-3)
    crossing = times[1:][(np.diff(np.sign(height)) != 0) & late[1:]]
    assert np.diff(crossing).mean() == pytest.approx(0.5 * period, rel=1e-3)


def test_slow_tilt_about_any_axis_keeps_the_surface_level():
    modes = cylinder_modes(0.049, 0.08, 40)
    times = np.arange(0.0, 12.0, 0.002)
    ramp = np.clip(times / 6.0, 0.0, 1.0)
    angle = 0.05 * ramp**3 * (10.0 - 15.0 * ramp + 6.0 * ramp**2)
    force = 9.81 * np.stack([-np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    turning = np.stack([np.zeros_like(angle), np.gradient(np.gradient(angle, 0.002), 0.002), np.zeros_like(angle)], -1)
    height = forced_response(modes, times, force, turning, damping=0.05)[-1, :, 0].sum()
    assert height == pytest.approx(np.tan(0.05) * modes.weight.sum(), rel=1e-3)


def test_shapes_of_a_tank_change_sign_from_wall_to_wall():
    modes = tank_modes(1.73, 0.6, 3)
    np.testing.assert_allclose(tank_shapes(modes, 0.865), 1.0)
    np.testing.assert_allclose(tank_shapes(modes, -0.865), -1.0, atol=1e-12)
    np.testing.assert_allclose(tank_shapes(modes, 0.0), 0.0, atol=1e-12)


def test_damping_of_a_clean_cylinder_of_water_is_half_a_percent():
    assert wall_damping_ratio(0.049, 1e-6) == pytest.approx(4.3e-3, rel=0.01)


def test_swirl_solves_the_diffusion_equation_and_vanishes_at_the_wall():
    radius, depth, nu, step = 0.035, 0.05, 1.12e-3, 1e-4
    angle = np.linspace(0.0, 6.0, 7)
    wall = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(7, 0.03)], axis=-1)
    assert np.abs(torsional_velocity(wall, radius, depth, 1.0)).max() < 1e-12
    inside = np.array([[0.01, 0.006, 0.02], [-0.02, 0.011, 0.045]])
    shifts = step * np.concatenate([np.eye(3), -np.eye(3)])
    around = sum(torsional_velocity(inside + s, radius, depth, 1.0) for s in shifts)
    laplacian = (around - 6.0 * torsional_velocity(inside, radius, depth, 1.0)) / step**2
    expected = -torsional_decay_rate(radius, depth, nu) / nu * torsional_velocity(inside, radius, depth, 1.0)
    np.testing.assert_allclose(laplacian, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_senseless_input_is_refused():
    with pytest.raises(OptionError, match="positive"):
        cylinder_modes(0.0, 0.1)
    with pytest.raises(OptionError, match="depth"):
        tank_modes(1.0, -0.1)
    with pytest.raises(OptionError, match="resolve"):
        forced_response(cylinder_modes(0.01, 0.1, 30), np.array([0.0, 0.01]), np.tile(UPRIGHT, (2, 1)))
