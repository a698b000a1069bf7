"""Meshes of glasses: closed, with the volumes of the closed forms, and with normals that point out of the medium."""

import numpy as np
import pytest

from zsdt.fluid.families import draw_shape
from zsdt.fluid.vessel import Vessel
from zsdt.lab.glass_mesh import ANGLES, FOOT_RADIUS, RIM_HEIGHT, GlassMesher, Mesh, glass_meshes, joined
from zsdt.lab.glass_surface import polar_heights
from zsdt.lab.glass_view import Glass
from zsdt.scene import VesselFamily, VesselShape

WALL, FLOOR, LEVEL = 0.0025, 0.006, 0.04
SHAPES = {
    "cylinder": VesselShape(VesselFamily.cylinder, [0.0, 0.1], [0.035, 0.035]),
    "tumbler": VesselShape(VesselFamily.tumbler, [0.0, 0.1], [0.03, 0.042]),
    "bowl": draw_shape(VesselFamily.bowl, 0.04, LEVEL, 0.04, np.random.default_rng(0)),
    "flask": draw_shape(VesselFamily.flask, 0.04, LEVEL, 0.05, np.random.default_rng(0)),
    "jar": VesselShape(VesselFamily.jar, [0.0, 0.1], [0.04, 0.04], aspect=0.7, exponent=4.5),
}
# A polygon of ANGLES sides has this share of the area of its circle.
POLYGON = np.sin(2.0 * np.pi / ANGLES) / (2.0 * np.pi / ANGLES)


def surface(shape: VesselShape, slope: float = 0.0) -> np.ndarray:
    """A free surface at LEVEL on the axis, tilted along x and bent along y."""
    return polar_heights(shape, lambda at: LEVEL + slope * at[:, 0] + 0.5 * slope * at[:, 1] ** 2 / 0.04)


def open_edges(meshes: list[Mesh]) -> int:
    """Edges that are not run along once in each direction, with vertices at one place taken as one."""
    mesh = joined(meshes)
    vertex = np.unique(np.round(mesh.vertices, 10), axis=0, return_inverse=True)[1].ravel()[mesh.faces]
    edges = np.concatenate([vertex[:, [0, 1]], vertex[:, [1, 2]], vertex[:, [2, 0]]])
    there, count = np.unique(edges[:, 0] * len(mesh.vertices) + edges[:, 1], return_counts=True)
    back = np.unique(edges[:, 1] * len(mesh.vertices) + edges[:, 0])
    return int((count != 1).sum()) + len(np.setxor1d(there, back))


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_the_three_interfaces_enclose_glass_liquid_and_both(name: str, slope: float) -> None:
    shape = SHAPES[name]
    meshes = GlassMesher(shape, WALL, FLOOR).meshes(surface(shape, slope))
    assert meshes.glass_liquid is not None and meshes.liquid_air is not None
    assert open_edges([meshes.glass_air, meshes.glass_liquid.flipped()]) == 0
    assert open_edges([meshes.glass_liquid, meshes.liquid_air]) == 0
    assert open_edges([meshes.glass_air, meshes.liquid_air]) == 0
    glass, liquid = (
        joined([meshes.glass_air, meshes.glass_liquid.flipped()]).volume(),
        joined([meshes.glass_liquid, meshes.liquid_air]).volume(),
    )
    both = joined([meshes.glass_air, meshes.liquid_air]).volume()
    assert glass > 0 and liquid > 0 and both == pytest.approx(glass + liquid, rel=1e-9)


@pytest.mark.parametrize("name", SHAPES)
def test_the_liquid_has_the_volume_of_the_vessel_below_its_level(name: str) -> None:
    shape = SHAPES[name]
    meshes = GlassMesher(shape, WALL, FLOOR).meshes(surface(shape))
    assert meshes.glass_liquid is not None and meshes.liquid_air is not None
    volume = joined([meshes.glass_liquid, meshes.liquid_air]).volume()
    exact = Vessel(shape).volume(LEVEL)
    assert volume == pytest.approx(exact * (POLYGON if shape.is_round else 1.0), rel=4e-3)


def test_a_tilted_surface_keeps_the_volume_of_a_cylinder() -> None:
    shape = SHAPES["cylinder"]
    tilted = polar_heights(shape, lambda at: LEVEL + 0.3 * at[:, 0])
    meshes = GlassMesher(shape, WALL, FLOOR).meshes(tilted)
    assert meshes.glass_liquid is not None and meshes.liquid_air is not None
    volume = joined([meshes.glass_liquid, meshes.liquid_air]).volume()
    assert volume == pytest.approx(POLYGON * np.pi * 0.035**2 * LEVEL, rel=1e-5)


def test_the_glass_of_a_cylinder_has_the_volume_of_its_closed_form() -> None:
    """A tube and a plate less the rounded foot and rim, each by Guldin's rule."""
    mesh = GlassMesher(SHAPES["cylinder"], WALL, FLOOR).meshes(None).glass_air
    inner, outer, rim = 0.035, 0.035 + WALL, 0.1
    whole = np.pi * (outer**2 * (rim + FLOOR) - inner**2 * rim)
    f, g = min(FOOT_RADIUS, 0.6 * WALL, 0.3 * FLOOR), min(RIM_HEIGHT, 0.5 * WALL)
    foot = (1 - np.pi / 4) * f**2 * 2 * np.pi * (outer - f * (1 - (5 / 6 - np.pi / 4) / (1 - np.pi / 4)))
    top = WALL * g * (1 - np.pi / 4) * 2 * np.pi * (inner + WALL / 2)
    assert mesh.volume() == pytest.approx(POLYGON * (whole - foot - top), rel=1e-3)
    assert open_edges([mesh]) == 0


@pytest.mark.parametrize("name", SHAPES)
def test_normals_have_length_one_and_agree_with_the_triangles(name: str) -> None:
    shape = SHAPES[name]
    meshes = GlassMesher(shape, WALL, FLOOR).meshes(surface(shape, 0.2))
    for mesh in (meshes.glass_air, meshes.glass_liquid, meshes.liquid_air):
        assert mesh is not None
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-9)
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        flat = np.cross(b - a, c - a)
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        assert np.einsum("fk,fvk->fv", flat, mesh.normals[mesh.faces]).min() > 0.6


def test_a_straight_wall_has_the_normal_of_its_cone_inside_and_outside() -> None:
    """A foot below and a rim above must not bend it: a wall with a bent normal is a prism and moves the level."""
    mesh = GlassMesher(SHAPES["tumbler"], WALL, FLOOR).meshes(None).glass_air
    slope = 0.12
    wall = (mesh.vertices[:, 2] > 0.01) & (mesh.vertices[:, 2] < 0.09)
    up, across = mesh.normals[wall, 2], np.hypot(mesh.normals[wall, 0], mesh.normals[wall, 1])
    np.testing.assert_allclose(np.abs(up / across), slope, atol=0.004)


def test_the_surface_touches_the_wall_everywhere() -> None:
    shape = SHAPES["bowl"]
    mesh = GlassMesher(shape, WALL, FLOOR).meshes(surface(shape, 0.3)).liquid_air
    assert mesh is not None
    contact = mesh.vertices[:ANGLES]
    # Between the points of the profile the glass is curved and the vessel of the solver is straight.
    np.testing.assert_allclose(np.hypot(contact[:, 0], contact[:, 1]), Vessel(shape).radius(contact[:, 2]), atol=1e-4)


def test_a_surface_beyond_rim_and_floor_stays_within_the_glass() -> None:
    shape = SHAPES["cylinder"]
    turn = 2.0 * np.pi * np.arange(16) / 16
    wild = 0.05 + np.linspace(0.0, 1.0, 5)[:, None] * 0.09 * np.cos(turn)
    meshes = glass_meshes(Glass(shape, WALL, FLOOR, np.zeros(3), wild))
    assert meshes.liquid_air is not None and meshes.glass_liquid is not None
    heights = meshes.liquid_air.vertices[:, 2]
    assert heights.min() > 0.0 and heights.max() < shape.rim
    assert open_edges([meshes.glass_liquid, meshes.liquid_air]) == 0
