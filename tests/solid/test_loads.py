"""Loads: patches, histories, follower pressure, and the way from the fine mesh to the grid of the graph."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.scene import BeamShape, Foam
from zsdt.solid.loads import (
    History,
    LoadCase,
    LoadOptions,
    Regime,
    bending_demand,
    bending_frequency,
    buckling_demand,
    draw_load,
)
from zsdt.solid.mesh import BrickMesh, CoarseView, Face, mesh_of
from zsdt.solid.solver import BrickSolver, Load

OUTWARD = {
    Face.top: (0, 0, 1),
    Face.bottom: (0, 0, -1),
    Face.front: (0, -1, 0),
    Face.back: (0, 1, 0),
    Face.tip: (1, 0, 0),
}


@pytest.mark.parametrize("face", list(Face))
def test_pressure_on_a_patch_is_its_force_against_the_outward_normal(face):
    mesh = BrickMesh((8, 4, 6), 0.025)
    case = LoadCase(face, (0.025, 0.1), (0.05, 0.1), 3.0, History("hold", (0.0, 1.0), (1.0, 1.0)))
    load = Load(faces=case.faces(mesh))
    solver = BrickSolver(mesh, Foam())
    solver.set_state(np.zeros((mesh.nodes, 3)), load=load, pressure=float(case.pressure(np.zeros(1))[0]))
    force = solver.frame().load
    np.testing.assert_allclose(force.sum(axis=0), -3.0 * np.array(OUTWARD[face]), atol=1e-12)
    touched = mesh.grid.points[np.abs(force).sum(axis=1) > 0]
    along = [axis for axis in range(3) if OUTWARD[face][axis] == 0]
    np.testing.assert_allclose(touched[:, along].min(axis=0), [0.025, 0.05])
    np.testing.assert_allclose(touched[:, along].max(axis=0), [0.1, 0.1])


def test_pressure_follows_the_surface():
    """After a quarter turn about x, pressure on what was the top acts along y."""
    mesh = BrickMesh((4, 2, 2), 0.05)
    quarter = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    solver = BrickSolver(mesh, Foam())
    load = Load(faces=mesh.patch(Face.top, (1, 3), (0, 2)))
    solver.set_state(mesh.grid.points @ (quarter - np.eye(3)).T, load=load, pressure=100.0)
    expected = quarter @ [0.0, 0.0, -100.0 * 0.1 * 0.1]
    np.testing.assert_allclose(solver.frame().load.sum(axis=0), expected, atol=1e-12)


def test_patch_that_leaves_the_face_is_refused():
    with pytest.raises(OptionError, match="does not fit on the top face"):
        BrickMesh((4, 2, 2), 0.05).patch(Face.top, (2, 5), (0, 1))


@pytest.mark.parametrize("coarse_edge", [0.05, 0.1])
def test_restricted_loads_keep_total_force_and_moment(coarse_edge):
    shape = BeamShape(0.4, 0.2, 0.3)
    view = CoarseView(mesh_of(shape, 0.025), mesh_of(shape, coarse_edge))
    fine, coarse = view.fine.grid.points, view.coarse.grid.points
    force = np.random.default_rng(0).standard_normal(fine.shape)
    restricted = view.spread @ force
    np.testing.assert_allclose(restricted.sum(axis=0), force.sum(axis=0), atol=1e-10)
    np.testing.assert_allclose(np.cross(coarse, restricted).sum(axis=0), np.cross(fine, force).sum(axis=0), atol=1e-10)
    np.testing.assert_allclose(view.spread @ view.fine.volume, view.coarse.volume)
    np.testing.assert_allclose(fine[view.picked], coarse, atol=1e-12)


def test_interpolation_is_exact_for_linear_fields():
    mesh = BrickMesh((3, 2, 4), 0.05)
    points = np.random.default_rng(0).uniform(0, 1, (50, 3)) * mesh.size
    matrix = mesh.interpolation(points)
    np.testing.assert_allclose(matrix @ (mesh.grid.points @ [1.0, -2.0, 3.0] + 0.5), points @ [1.0, -2.0, 3.0] + 0.5)
    with pytest.raises(OptionError, match="outside the brick"):
        mesh.interpolation(points + 1.0)


def test_mesh_that_does_not_fill_the_beam_is_refused():
    with pytest.raises(OptionError, match="do not fill"):
        mesh_of(BeamShape(0.35, 0.1, 0.1), 0.1)


def test_history_joins_its_knots_smoothly_and_holds_outside():
    history = History("ramps", (0.2, 0.6, 1.0), (0.0, 1.0, 0.5))
    time = np.linspace(-0.5, 2.0, 20001)
    value = history(time)
    np.testing.assert_allclose(history(np.array([-1.0, 0.2, 0.4, 0.6, 1.0, 5.0])), [0, 0, 0.5, 1, 0.5, 0.5], atol=1e-12)
    assert value.min() >= 0.0 and value.max() <= 1.0 + 1e-12
    rate = np.gradient(value, time)
    assert np.abs(np.diff(rate)).max() < 0.02  # no kinks
    sine = History("sine", (0.0, 1.0), (0.0, 0.0), amplitude=1.0, frequency=5.0, sine_start=0.1)
    assert np.all(sine(time[time < 0.1]) == 0.0)
    np.testing.assert_allclose(sine(np.array([0.35, 1.15])), [1.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("regime", list(Regime))
def test_drawn_loads_keep_their_promises(regime):
    rng = np.random.default_rng(7)
    shape, material, options = BeamShape(0.45, 0.15, 0.2), Foam(), LoadOptions()
    mesh, duration = mesh_of(shape, 0.025), 1.7
    cases = [draw_load(rng, shape, material, regime, duration, mesh.edge, options) for _ in range(300)]
    assert {c.face for c in cases} == set(Face)
    assert {c.force > 0 for c in cases} == {True, False}
    time = np.linspace(0.0, duration, 2000)
    for case in cases:
        assert 1.0 <= abs(case.force) <= 5.0
        assert len(case.faces(mesh)) * mesh.edge**2 == pytest.approx(case.area)
        sides = [case.first[1] - case.first[0], case.second[1] - case.second[0]]
        assert min(sides) > 0.05 - 1e-9 and max(sides) < 0.2 + 1e-9
        factor = case.history(time)
        assert np.ptp(factor) > 0.0
        if regime is Regime.hand:
            fastest = np.abs(np.gradient(factor, time)).max()
            assert fastest <= np.pi / 2.0 / options.ramp[0] + 1e-6  # half cosine over the shortest ramp
    if regime is Regime.dynamic:
        assert {c.history.kind for c in cases} == {"release", "impulse", "sine"}


def test_demand_is_the_elementary_bending_stress():
    shape, material = BeamShape(0.8, 0.1, 0.1), Foam()
    case = LoadCase(Face.top, (0.7, 0.8), (0.0, 0.1), 1.0, History("hold", (0.0, 1.0), (1.0, 1.0)))
    weight = 18.44 * 9.81 * 0.01
    relaxed = 9 * 37500.0 * 8653.846 / (3 * 37500.0 + 8653.846)
    expected = 6 * (1.0 * 0.75 + weight * 0.32) / 1e-3 / (0.192 * relaxed)
    assert bending_demand(shape, material, 9.81, case) == pytest.approx(expected, rel=1e-5)


def test_frequency_estimate_lies_between_relaxed_and_instantaneous():
    shape, foam = BeamShape(0.8, 0.1, 0.1), Foam()
    stiff = bending_frequency(shape, Foam(g1=0.0))
    assert stiff == pytest.approx(1.237, rel=0.01)  # Timoshenko, elastic
    assert 0.7 * stiff < bending_frequency(shape, foam) < stiff
    assert bending_frequency(BeamShape(0.5, 0.3, 0.1), foam, sideways=True) > 2 * bending_frequency(
        BeamShape(0.5, 0.3, 0.1), foam
    )


def test_buckling_demand_is_eulers_load_of_the_thinner_side_and_for_pushes_only():
    shape, foam = BeamShape(0.4, 0.2, 0.1), Foam()
    young = 9 * 37500.0 * 8653.846 / (3 * 37500.0 + 8653.846)
    euler = np.pi**2 * young * 0.2 * 0.1**3 / 12 / (4 * 0.4**2)
    hold = History("hold", (0.0, 1.0), (1.0, 1.0))
    sine = History("sine", (0.0, 1.0), (0.0, 0.0), amplitude=1.0, frequency=3.0)

    def demand(face, force, history):
        return buckling_demand(shape, foam, LoadCase(face, (0.0, 0.1), (0.0, 0.1), force, history))

    assert demand(Face.tip, 2.0, hold) == pytest.approx(2.0 / euler, rel=1e-6)
    assert demand(Face.tip, -2.0, hold) == 0.0
    assert demand(Face.tip, -2.0, sine) == pytest.approx(2.0 / euler, rel=1e-6)
    assert demand(Face.top, 2.0, hold) == 0.0
