"""Potential flow of a pushed liquid against the closed form of a cylinder, and what must hold in any vessel."""

import numpy as np
import pytest
from scipy.special import iv, ivp

from zsdt.fluid.impulse import impulse_of
from zsdt.fluid.sampling import fill
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily, VesselShape

RADIUS, LEVEL = 0.035, 0.05


def pushed(shape, level, particles, seed=0):
    vessel = Vessel(shape)
    filled = fill(vessel, level, particles, np.random.default_rng(seed))
    return filled.points, impulse_of(filled.points, *vessel.distance_and_normal(filled.points), filled.spacing)


def cylinder_potential(x, terms=60):
    """Gradient of P for a unit push along x: cosine series in z that vanishes at the level, Bessel I1 in r."""
    r = np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-9)
    cos, sin = x[:, 0] / r, x[:, 1] / r
    out = np.zeros_like(x)
    for n in range(terms):
        k = (2 * n + 1) * np.pi / (2 * LEVEL)
        size = 4 * (-1) ** n / ((2 * n + 1) * np.pi) / (k * ivp(1, k * RADIUS))
        across, along = size * k * ivp(1, k * r) * cos, -size * iv(1, k * r) / r * sin
        out[:, 0] += (across * cos - along * sin) * np.cos(k * x[:, 2])
        out[:, 1] += (across * sin + along * cos) * np.cos(k * x[:, 2])
        out[:, 2] -= size * k * iv(1, k * r) * cos * np.sin(k * x[:, 2])
    return out


@pytest.fixture(scope="module")
def cylinders():
    shape = VesselShape(heights=[0.0, 0.12], radii=[RADIUS, RADIUS])
    return {n: pushed(shape, LEVEL, n) for n in (500, 2000)}


def error_of(points, impulse):
    exact = np.array([1.0, 0.0, 0.0]) - cylinder_potential(points)
    return np.sqrt(((impulse.response[:, :, 0] - exact) ** 2).sum() / (exact**2).sum())


def test_a_cylinder_moves_as_the_closed_form_says_and_better_with_more_particles(cylinders):
    coarse, fine = error_of(*cylinders[500]), error_of(*cylinders[2000])
    assert fine < coarse < 0.25
    assert fine < 0.18


def test_a_level_liquid_cannot_be_pushed_into_its_floor(cylinders):
    points, impulse = cylinders[500]
    assert np.sqrt((impulse.response[:, :, 2] ** 2).sum(1).mean()) < 0.06
    depth = LEVEL - points[:, 2]
    np.testing.assert_allclose(-impulse.pressure[:, 2], depth, atol=0.15 * LEVEL)


def test_the_answer_is_a_projection(cylinders):
    """Pushing again with the flow that came out changes nothing: mean of e.Ue is that of |Ue|^2."""
    u = cylinders[2000][1].response[:, :, 0]
    assert abs((u**2).sum(1).mean() / u[:, 0].mean() - 1) < 0.1


def test_nothing_flows_through_the_wall(cylinders):
    points, impulse = cylinders[500]
    distance, normal = Vessel(VesselShape(heights=[0.0, 0.12], radii=[RADIUS] * 2)).distance_and_normal(points)
    near = distance < 0.005
    through = np.einsum("na,nab->nb", normal, impulse.response)[near]
    assert np.sqrt((through**2).mean()) < 0.08


def test_a_flask_filled_into_its_neck_holds_its_liquid():
    heights, radii = [0.0, 0.05, 0.065, 0.12], [0.04, 0.04, 0.018, 0.018]
    _, held = pushed(VesselShape(VesselFamily.flask, heights, radii), 0.085, 600)
    _, free = pushed(VesselShape(VesselFamily.flask, heights, radii), 0.04, 600)
    assert held.response[:, 0, 0].mean() < 0.15 < 0.3 < free.response[:, 0, 0].mean()


def test_turned_and_mirrored_liquids_answer_alike():
    shape = VesselShape(heights=[0.0, 0.12], radii=[0.03, 0.04])
    vessel, filled = Vessel(shape), fill(Vessel(shape), 0.045, 300, np.random.default_rng(1))
    points = filled.points * [1.0, 0.9, 1.0]
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([1.0, -1.0, 1.0])
    one, two = (impulse_of(p, *vessel.distance_and_normal(p), filled.spacing) for p in (points, points @ turn.T))
    np.testing.assert_allclose(two.response, turn @ one.response @ turn.T, atol=2e-6)
    np.testing.assert_allclose(two.air, one.air, atol=1e-9)
