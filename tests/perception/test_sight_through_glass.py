"""Lines of sight through the wall of a glass, against closed forms of a cylindrical shell."""

import numpy as np

from zsdt.perception.glass_rays import FAR, MISSED, NEAR, OVER, GlassWalls, contacts
from zsdt.scene import VesselFamily, VesselShape

INNER, WALL, INDEX = 0.035, 0.002, 1.5
WALLS = GlassWalls.of(VesselShape(VesselFamily.cylinder, [0.0, 0.1], [INNER, INNER]), WALL, 0.006, INDEX)


def aimed(offset: float, climb: float = 0.0, height: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A line of sight along y that passes the axis at a distance [m], from 0.4 m away; what it meets."""
    way = np.array([[0.0, 1.0, climb]]) / np.hypot(1.0, climb)
    points, met = contacts(WALLS, np.array([offset, -0.4, height - 0.4 * climb]), way)
    return points[0], met[0], way[0]


def test_a_level_line_through_the_axis_is_not_bent() -> None:
    point, met, _ = aimed(0.0)
    assert met == FAR and np.allclose(point, [0.0, -INNER, 0.05], atol=1e-7)  # level: near and far are as high


def test_the_far_wall_of_a_descending_line_is_lowered_by_snell_alone() -> None:
    climb = -0.3
    point, met, _ = aimed(0.0, climb)
    inside = np.tan(np.arcsin(np.sin(np.arctan(climb)) / INDEX))
    expected = 0.05 - climb * (INNER + WALL) + WALL * inside + 2 * INNER * climb
    assert met == FAR and np.allclose(point, [0.0, INNER, expected], atol=1e-6)
    assert expected - (0.05 + INNER * climb) > 1e-4  # more than a tenth of a millimetre: it pays


def test_a_level_line_beside_the_axis_keeps_its_moment_and_is_totally_reflected_beyond_the_cavity() -> None:
    # n times the distance from the axis is the same before the glass, in it, and in the air of the cavity.
    point, met, _ = aimed(0.02)
    out, within = INNER + WALL, np.arcsin(0.02 / (INDEX * INNER)) - np.arcsin(0.02 / (INDEX * (INNER + WALL)))
    assert met == FAR
    assert np.isclose(np.arctan2(point[1], point[0]), -np.pi / 2 + np.arcsin(0.02 / out) + within, atol=1e-6)
    assert aimed(INNER - 1e-4)[1] == FAR and aimed(INNER + 1e-4)[1] == NEAR
    assert aimed(INNER + WALL + 1e-4)[1] == MISSED and np.isnan(aimed(INNER + WALL + 1e-4)[0]).all()


def test_over_the_rim_nothing_refracts() -> None:
    point, met, _ = aimed(0.0, -0.5, 0.13)
    assert met == OVER and np.allclose(point, [0.0, INNER, 0.13 - 0.5 * INNER], atol=1e-6)


def test_a_prism_with_a_round_section_is_a_cylinder() -> None:
    prism = GlassWalls.of(VesselShape(VesselFamily.jar, [0.0, 0.1], [INNER, INNER], 1.0, 2.0001), WALL, 0.006, INDEX)
    rng = np.random.default_rng(0)
    way = np.column_stack([rng.uniform(-0.06, 0.06, 40), np.ones(40), rng.uniform(-0.2, 0.1, 40)])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    eye = np.array([0.01, -0.4, 0.06])
    (one, met), (other, met_too) = contacts(WALLS, eye, way), contacts(prism, eye, way)
    assert (met == met_too).all() and np.allclose(one, other, atol=2e-5, equal_nan=True)
