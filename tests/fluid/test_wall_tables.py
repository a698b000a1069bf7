"""Wall tables against closed forms: a plane floor, a right-angled edge, a sheared liquid over a wall."""

import numpy as np
import pytest
from scipy.integrate import quad

from zsdt.errors import OptionError
from zsdt.fluid.kernel import kernel, kernel_slope, plane_area, plane_beyond, plane_moment
from zsdt.fluid.vessel import Vessel
from zsdt.fluid.wall_tables import LIFT, SHEAR, SHEAR_DEPTH, WallTables
from zsdt.scene import VesselFamily, VesselShape

H = 0.008


@pytest.fixture(scope="module")
def tables() -> WallTables:
    return WallTables(Vessel(VesselShape(heights=[0.0, 0.06], radii=[0.04, 0.04])), H)


def above_floor(heights) -> np.ndarray:
    """Points on the axis, where only the floor is near."""
    return np.stack([np.zeros_like(heights), np.zeros_like(heights), heights], axis=1)


def test_kernel_is_one_and_its_plane_integrals_agree_with_quadrature():
    volume = quad(lambda r: 4 * np.pi * r**2 * kernel(np.array([r]), H)[0], 0, 2 * H)[0]
    assert volume == pytest.approx(1.0, rel=1e-9)
    for s in (0.1 * H, 0.7 * H, 1.5 * H):
        area = quad(lambda r: 2 * np.pi * r * kernel(np.array([r]), H)[0], s, 2 * H)[0]
        assert plane_area(np.array([s]), H)[0] == pytest.approx(area, rel=1e-8)
        beyond = quad(lambda t: float(plane_area(np.array([t]), H)[0]), s, 2 * H)[0]
        assert plane_beyond(np.array([s]), H)[0] == pytest.approx(beyond, rel=1e-8)
    step = 1e-6 * H
    slope = (kernel(np.array([H + step]), H)[0] - kernel(np.array([H - step]), H)[0]) / (2 * step) / H
    assert kernel_slope(np.array([H]), H)[0] == pytest.approx(slope, rel=1e-6)


def test_gamma_and_its_gradient_at_a_plane_floor(tables):
    z = np.linspace(0.1, 2.4, 40) * H
    gamma, gradient = tables.gamma(above_floor(z))
    np.testing.assert_allclose(gamma, 1.0 - plane_beyond(z, H), atol=0.01)
    np.testing.assert_allclose(gradient[:, 2] * H, plane_area(z, H) * H, atol=0.025)
    np.testing.assert_allclose(gradient[:, :2] * H, 0.0, atol=1e-3)
    assert np.all(gamma[z > 2.2 * H] > 1.0 - 1e-4)


def test_a_quarter_of_the_kernel_is_left_in_a_right_angled_edge():
    wide = Vessel(VesselShape(VesselFamily.jar, [0.0, 0.06], [0.04, 0.04], aspect=1.0, exponent=12.0))
    gamma, gradient = WallTables(wide, H).gamma(np.array([[0.04, 0.0, 0.0]]))
    assert gamma[0] == pytest.approx(0.25, abs=0.02)
    assert gradient[0, 0] == pytest.approx(-gradient[0, 2], rel=0.05)
    assert gradient[0, 2] > 0


def test_the_lift_makes_up_for_what_a_plane_floor_hides(tables):
    z = np.linspace(0.45, 2.2, 71) * H
    slopes = tables.lift_slopes(above_floor(z))
    np.testing.assert_allclose(slopes[:, 2, 2], plane_moment(z, H), atol=0.06)  # constant in a cell of the table
    assert slopes[:, 2, 2].mean() == pytest.approx(plane_moment(z, H).mean(), rel=0.02)
    np.testing.assert_allclose(slopes[:, 0, :], 0.0, atol=0.01)


def test_the_lift_has_a_potential(tables):
    """Its slope is the derivative of the interpolated vector, and symmetric up to the interpolation."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.037, -0.037, 0.003], [0.037, 0.037, 0.02], (60, 3))
    points = points[np.hypot(points[:, 0], points[:, 1]) < 0.037]
    place = (points - tables.low) * tables.inverse_spacing
    points = tables.low + (np.floor(place) + 0.1 + 0.8 * (place % 1.0)) * tables.spacing  # off the faces of cells
    slopes, step = tables.lift_slopes(points), 0.01 * tables.spacing
    for m in range(3):
        away = np.eye(3)[m] * step
        slope = (tables.rows(points + away) - tables.rows(points - away))[:, LIFT : LIFT + 3] / (2 * step)
        np.testing.assert_allclose(slopes[:, :, m], slope, atol=1e-6)
    np.testing.assert_allclose(slopes, np.swapaxes(slopes, 1, 2), atol=0.05)


def test_no_slip_drag_of_a_sheared_liquid_is_the_integral_over_the_wall(tables):
    """Velocity (z, 0, 0) inside and its linear continuation in the floor: drag per volume and viscosity."""

    def over_plane(t: float) -> float:
        """Integral of 10 x^2 W'/r / (r^2 + 0.01 h^2) over a plane at distance t."""
        r = np.linspace(0.0, 2 * H, 400)
        away = np.hypot(r, t)
        return float(np.trapezoid(10 * np.pi * r**3 * kernel_slope(away, H) / (away**2 + 0.01 * H**2), r))

    heights = np.linspace(0.2, 1.4, 25) * H
    rows = tables.rows(above_floor(heights))
    found = (rows[:, SHEAR] * heights + rows[:, SHEAR_DEPTH]).sum()
    exact = -sum(quad(lambda t: t * over_plane(t), z, 2 * H, epsrel=1e-4)[0] for z in heights)
    assert found == pytest.approx(exact, rel=0.01)


def test_above_the_rim_there_is_no_wall(tables):
    gamma, gradient = tables.gamma(np.array([[0.0, 0.0, 0.055], [0.02, 0.0, 0.06 + 2.0 * H]]))
    np.testing.assert_allclose(gamma, 1.0, atol=1e-4)
    np.testing.assert_allclose(gradient * H, 0.0, atol=1e-3)


def test_tables_refuse_what_makes_no_sense():
    with pytest.raises(OptionError, match="positive smoothing length"):
        WallTables(Vessel(VesselShape()), 0.0)
