"""Light through surfaces, held against the optics of a plate: Snell, Fresnel, Beer and Lambert, and no light lost."""

import numpy as np
import pytest

from zsdt.lab.glass_mesh import Mesh
from zsdt.lab.raytrace_caster import Hits
from zsdt.lab.raytrace_light import AIR, Interface, Medium, Seen, follow, fresnel, joined_surfaces

GLASS = Medium(1.5, np.zeros(3))
THICK = 0.01


def plane(height: float, up: float) -> Mesh:
    """A square of 2 m at a height whose normal points up (1) or down (-1)."""
    corners = np.array([[-1.0, -1.0, height], [1.0, -1.0, height], [1.0, 1.0, height], [-1.0, 1.0, height]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(corners, np.tile([0.0, 0.0, up], (4, 1)), faces if up > 0 else faces[:, ::-1])


class EveryTriangle:
    """Tries all triangles of a mesh."""

    def __init__(self, mesh: Mesh):
        self.mesh = mesh

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        best, hits = np.full(len(origins), np.inf), Hits(*(np.zeros(len(origins), kind) for kind in ("i4", "f4", "f4")))
        hits.face[:] = -1
        for number, face in enumerate(self.mesh.faces):
            a, b, c = self.mesh.vertices[face]
            for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
                matrix = np.column_stack([-d, b - a, c - a])
                if abs(np.linalg.det(matrix)) < 1e-12:
                    continue
                t, u, v = np.linalg.solve(matrix, o - a)
                if min(u, v) >= 0 and u + v <= 1 and 1e-9 < t < best[i]:
                    best[i], hits.face[i], hits.u[i], hits.v[i] = t, number, u, v
        return hits


def plate(medium: Medium) -> list[Interface]:
    """A plate from z = 0 to -THICK in air."""
    return [Interface(plane(0.0, 1.0), medium, AIR, False), Interface(plane(-THICK, -1.0), medium, AIR, False)]


def look(interfaces: list[Interface], light, way, turns: int = 1, start: float = 0.3) -> Seen:
    """What `turns` rays of one pixel see that meet z = 0 at the place (0.1, 0.2)."""
    mesh, surfaces = joined_surfaces(interfaces)
    way = np.asarray(way, float) / np.linalg.norm(way)
    origin = np.array([0.1, 0.2, 0.0]) - start * way
    return follow(
        surfaces,
        EveryTriangle(mesh).cast,
        light,
        np.tile(origin, (turns, 1)),
        np.tile(way, (turns, 1)),
        turn=np.arange(turns),
        turns=turns,
        depth=8,
        dim=np.ones(3),
    )


def test_fresnels_equations() -> None:
    assert fresnel(1.0, 1.0 / 1.5)[0] == pytest.approx(0.04)
    brewster = np.arctan(1.5)
    across = np.sin(brewster - np.arcsin(np.sin(brewster) / 1.5)) ** 2  # nothing of the other polarisation
    assert fresnel(np.cos(brewster), 1.0 / 1.5)[0] == pytest.approx(0.5 * across)
    critical = np.arcsin(1.0 / 1.5)
    assert fresnel(np.cos(critical + 1e-3), 1.5) == (1.0, 0.0)
    assert fresnel(np.cos(critical - 1e-3), 1.5)[0] < 1.0
    assert fresnel(0.3, 1.0)[0] == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("turns", [1, 4])
@pytest.mark.parametrize("slope", [0.0, 0.6, 4.0])
def test_in_light_from_all_sides_a_clear_plate_is_not_seen(turns: int, slope: float) -> None:
    seen = look(plate(GLASS), lambda o, d: np.ones((len(d), 3)), [slope, 0.2 * slope, -1.0], turns)
    np.testing.assert_allclose(seen.radiance.mean(axis=0), 1.0, atol=1e-5)
    assert seen.container.all() and not seen.liquid.any()


def test_a_ray_leaves_a_plate_parallel_and_shifted() -> None:
    left = {}

    def light(origins: np.ndarray, ways: np.ndarray) -> np.ndarray:
        down = ways[:, 2] < 0
        if down.any():
            left["place"], left["way"] = origins[down][0].astype(float), ways[down][0].astype(float)
        return np.zeros((len(ways), 3))

    angle = np.radians(40.0)
    look(plate(GLASS), light, [np.sin(angle), 0.0, -np.cos(angle)])
    np.testing.assert_allclose(left["way"], [np.sin(angle), 0.0, -np.cos(angle)], atol=1e-6)
    inside = np.arcsin(np.sin(angle) / 1.5)
    assert left["place"][0] - 0.1 == pytest.approx(THICK * np.tan(inside), abs=2e-5)


def test_what_passes_and_what_comes_back_from_a_plate() -> None:
    share = 0.04
    through = look(plate(GLASS), lambda o, d: (d[:, 2:] < 0) * np.ones(3), [0, 0, -1.0]).radiance[0]
    back = look(plate(GLASS), lambda o, d: (d[:, 2:] > 0) * np.ones(3), [0, 0, -1.0]).radiance[0]
    unfollowed = (1 - share) * share * share  # a reflection of a reflection counts as dim light
    np.testing.assert_allclose(through, (1 - share) ** 2 + unfollowed, rtol=1e-5)
    np.testing.assert_allclose(back, share + (1 - share) * share * (1 - share) + unfollowed, rtol=1e-5)


def test_light_is_absorbed_on_its_way() -> None:
    tinted = Medium(1.0001, np.array([0.0, 50.0, 200.0]))
    seen = look(plate(tinted), lambda o, d: np.ones((len(d), 3)), [0, 0, -1.0])
    np.testing.assert_allclose(seen.radiance[0], np.exp(-np.array([0.0, 50.0, 200.0]) * THICK), rtol=3e-3)


def test_liquid_behind_glass_is_told_apart() -> None:
    liquid = Medium(1.473, np.zeros(3))
    pool = [
        Interface(plane(0.0, 1.0), GLASS, AIR, False),
        Interface(plane(-THICK, 1.0), liquid, GLASS, True),
    ]
    ones = lambda o, d: np.ones((len(d), 3))  # noqa: E731
    assert look(pool, ones, [0.5, 0.0, -1.0]).liquid.all()
    assert look(pool[::-1], ones, [0.5, 0.0, -1.0]).liquid.all()
    assert not look(pool[:1], ones, [0.5, 0.0, -1.0]).liquid.any()


def test_total_reflection_keeps_the_light_and_ends_the_view_of_liquid() -> None:
    """Seen from within: light beyond the critical angle stays in the glass, and what it meets then is not said."""
    steep = [0.9, 0.0, -np.sqrt(1 - 0.81)]
    inside = [
        Interface(plane(0.0, 1.0), AIR, GLASS, False),
        Interface(plane(2 * THICK, -1.0), Medium(1.473, np.zeros(3)), GLASS, True),
    ]
    seen = look(inside, lambda o, d: (d[:, 2:] > 0) * np.ones(3), steep, start=0.02)
    np.testing.assert_allclose(seen.radiance[0], 1.0, atol=1e-3)
    assert seen.container[0] and not seen.liquid[0]
