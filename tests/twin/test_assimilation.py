"""The observer of the modes: closed forms of its dynamics, whom it believes, and the port through which it acts."""

import numpy as np
import pytest
import scipy.linalg

from tests.twin.beam_clips import FPS, cell_engine, scene_of
from zsdt.errors import OptionError
from zsdt.tignn.cell_port import displace
from zsdt.tignn.cell_stepping import settle
from zsdt.twin.assimilation import (
    AssimilationOptions,
    ModeObserver,
    discrete,
    evidence,
    mode_rates,
    robust_fit,
)
from zsdt.twin.beam_graph import beam_body
from zsdt.twin.modes import ModeWarp, stiffness_matrix, vibration_modes


def prepared(columns=7, rows=3, width=0.1):
    body = beam_body(columns, rows, scene_of(width), FPS)
    engine = cell_engine()
    engine.prepare(body)
    zero = np.zeros_like(body.points)
    state = engine.start({"position": body.points.copy(), "velocity": zero}, zero)
    return engine, body, state


def test_stiffness_is_the_derivative_of_the_force_and_knows_no_rigid_motion():
    engine, body, _ = prepared()
    matrix = stiffness_matrix(engine, body.points)
    move = 1e-5 * np.random.default_rng(0).standard_normal(body.points.shape)
    change = engine.internal_force(body.points - move) - engine.internal_force(body.points + move)
    assert np.abs((matrix @ move.ravel()).reshape(-1, 3) - 0.5 * change).max() < 1e-4 * np.abs(change).max()
    turn = np.cross(np.array([0.1, -0.2, 0.3]), body.points) + np.array([1.0, 2.0, 3.0])
    assert np.abs(matrix @ turn.ravel()).max() < 1e-4 * np.abs(matrix).max()


def test_modes_are_orthonormal_sorted_and_swing_at_the_frequency_of_beam_theory():
    engine, body, state = prepared(columns=15, rows=3, width=0.1)
    modes = vibration_modes(engine, body.points + state.u[:-1], 6, 4)
    flat = modes.shapes.reshape(-1, 10)
    np.testing.assert_allclose(flat.T @ (np.repeat(engine.inertia, 3)[:, None] * flat), np.eye(10), atol=1e-8)
    assert (np.diff(modes.frequency[:6]) > 0).all() and (np.diff(modes.frequency[6:]) > 0).all()
    assert modes.planar.tolist() == [True] * 6 + [False] * 4
    young = 9 * 37500 * 8653.8 / (3 * 37500 + 8653.8)
    theory = 1.8751**2 / 0.7**2 * np.sqrt(young * 0.1**2 / 12 / 18.44)
    assert modes.frequency[0] == pytest.approx(theory, rel=0.08)
    sideways = modes.shapes[:, :, 6:]
    middle = np.isclose(body.points[:, 1], 0.05)
    assert np.abs(sideways[middle][:, [0, 2]]).max() < 1e-9


def test_turned_modes_do_not_stretch_a_bent_beam():
    """Moved along a mode of the straight body, a bent beam is stretched; along the turned one it is bent on."""
    engine, body, _ = prepared(columns=13, rows=3)
    modes = vibration_modes(engine, body.points, 3, 0)
    warp = ModeWarp(body, modes, body.points)
    np.testing.assert_allclose(warp.shapes(np.zeros_like(body.points)), modes.shapes, atol=1e-9 * 50)
    curve, x, z = 1.5, body.points[:, 0], body.points[:, 2] - 0.05
    bent = body.points.copy()
    bent[:, 0] = np.sin(curve * x) / curve + z * np.sin(curve * x)
    bent[:, 2] = (np.cos(curve * x) - 1) / curve + z * np.cos(curve * x) + 0.05
    axis = np.flatnonzero(np.isclose(z, 0) & np.isclose(body.points[:, 1], 0.05))
    lengths = []
    for shapes in (modes.shapes, warp.shapes(bent - body.points)):
        step = 1e-3 * shapes[..., 0] / np.abs(shapes[..., 0]).max()
        before, after = (np.linalg.norm(np.diff(p[axis], axis=0), axis=1) for p in (bent, bent + step))
        lengths.append(np.abs(after / before - 1).max())
    assert lengths[1] < 0.1 * lengths[0]


def test_transition_and_noise_are_those_of_the_continuous_mode():
    rates = mode_rates(30.0, 1.9, 0.05, 10.0)
    density = np.diag([0.0, 0.0, 0.0, 4.0])
    transition, spread = discrete(rates, density, 1 / 60)
    np.testing.assert_allclose(transition, scipy.linalg.expm(rates / 60), rtol=1e-9, atol=1e-12)
    times = (np.arange(4000) + 0.5) / 4000 / 60
    summed = sum(scipy.linalg.expm(rates * t) @ density @ scipy.linalg.expm(rates * t).T for t in times) / 4000 / 60
    np.testing.assert_allclose(spread, summed, rtol=1e-4, atol=1e-12 * np.abs(summed).max())
    held = np.linalg.solve(rates[:3, :3], -rates[:3, 3])
    assert held[0] == pytest.approx(1 / 30.0**2)  # a load that stays holds the relaxed spring


def test_a_mode_under_an_unknown_load_is_found_with_its_load():
    """One mode, no engine: amplitude and load come out right although only noisy amplitudes are seen."""
    options = AssimilationOptions(load_rate=3.0)
    omega, mass = 25.0, 0.3
    observer = ModeObserver(np.array([omega]), 1.9, 0.05, 1 / FPS, mass, 3.0, options)
    rates = mode_rates(omega, 1.9, 0.05, 1e9)
    step = scipy.linalg.expm(rates / FPS)
    truth, belief = np.array([0.0, 0.0, 0.0, 2.0]), np.zeros(4)
    rng = np.random.default_rng(0)
    rows, found = np.ones((20, 1, 1)) / 2e-4, []
    for _ in range(180):
        truth, belief[3] = step @ truth, observer.force[0]
        belief = step @ belief
        observer.forecast()
        gap = (truth[0] - belief[0] + 2e-4 * rng.standard_normal((20, 1))) / 2e-4
        fit = robust_fit(rows, gap, np.ones(20, bool), observer.prior, 5.0)
        change, push = observer.update(fit, 1.0)
        belief[:3] += np.array([change[0], push[0], change[0]])
        found.append(observer.force[0])
    assert np.mean(found[60:]) == pytest.approx(2.0, rel=0.05)
    assert belief[0] == pytest.approx(truth[0], abs=2e-4)
    assert (np.linalg.eigvalsh(observer.covariance[0]) > -1e-12).all()


def test_outliers_do_not_move_the_fit_but_a_crowd_that_moves_together_does():
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((40, 2, 3))
    truth = np.array([3.0, -2.0, 1.0])
    gap = rows @ truth + rng.standard_normal((40, 2))
    seen = np.ones(40, bool)
    prior = np.full(3, 25.0)
    clean = robust_fit(rows, gap, seen, prior, 5.0)
    gap[:6] += 80.0
    gap[6] = np.nan
    found = robust_fit(rows, gap, seen, prior, 5.0)
    assert not found.taken[:7].any() and found.taken[7:].all()
    np.testing.assert_allclose(found.amplitude, clean.amplitude, atol=0.5)
    tight = np.full(3, 1e-2)
    assert robust_fit(rows, rows @ (20 * truth), seen, tight, 5.0).taken.all()
    assert robust_fit(rows, rows @ (20 * truth), seen, tight, 5.0).surprise > 100
    nothing = robust_fit(rows, gap, np.zeros(40, bool), prior, 5.0)
    assert not nothing.taken.any() and (nothing.amplitude == 0).all()


def test_evidence_prefers_the_prior_from_which_the_data_came():
    rng = np.random.default_rng(2)
    rows = rng.standard_normal((50, 2, 2))
    seen = np.ones(50, bool)
    small, large = np.full(2, 0.01), np.full(2, 100.0)
    for prior, other in ((small, large), (large, small)):
        gap = rows @ (np.sqrt(prior) * np.array([1.0, -1.0])) + rng.standard_normal((50, 2))
        fit = robust_fit(rows, gap, seen, large, 5.0)
        assert evidence(rows, gap, fit, prior) > evidence(rows, gap, fit, other)


def test_a_displacement_is_felt_by_the_memory_and_its_work_is_the_change_of_energy():
    engine, body, state = prepared()
    modes = vibration_modes(engine, body.points + state.u[:-1], 2, 0)
    move = 0.01 * modes.shapes[..., 0] / np.abs(modes.shapes[..., 0]).max()
    moved, work = displace(engine, state, move, 0.1 * move)
    assert state.u[-2, 2] != moved.u[-2, 2]
    before, after = engine.account(state), engine.account(moved)
    total = [a["kinetic"] + a["elastic"] + a["dissipated"] - a["work_of_ports"] for a in (before, after)]
    assert total[1] - total[0] == pytest.approx(work, rel=1e-9)
    assert work > 0 and after["dissipated"] == before["dissipated"]
    stiff = engine.read(moved)["stress"] - engine.read(state)["stress"]
    settle(engine.tables, moved.memory, moved.u, engine.gain, engine.corner, moved.force)  # held there for ever
    relaxed = engine.read(moved)["stress"] - engine.read(state)["stress"]
    ratio = np.linalg.norm(stiff[:, 0]) / np.linalg.norm(relaxed[:, 0])
    assert 1.4 < ratio < 2.0  # instantaneous over relaxed: 1 for volume, which does not relax, 2 for shear


def test_displacing_by_nothing_changes_nothing():
    engine, body, state = prepared()
    for _ in range(3):
        state = engine.step(state, np.zeros_like(body.points), np.zeros_like(body.points))
    same, work = displace(engine, state, np.zeros_like(body.points), np.zeros_like(body.points))
    np.testing.assert_allclose(same.force, state.force, rtol=1e-9, atol=1e-12)
    assert np.array_equal(same.memory.history, state.memory.history) and abs(work) < 1e-12


@pytest.mark.parametrize("wrong", [{"gain": 1.5}, {"noise": 0.0}, {"modes": 0}, {"forget": -1.0}, {"shake": -1.0}])
def test_senseless_options_are_refused(wrong):
    with pytest.raises(OptionError):
        AssimilationOptions(**wrong)


def test_a_mode_that_dies_within_a_small_part_of_a_frame_stays_known():
    omega, damping, dt = 187.0, 4.3e4, 1.0 / 60.0  # of a ripple on glycerin
    rates, density = np.array([[0.0, 1.0], [-(omega**2), -2.0 * damping]]), np.diag([0.0, 1.0])
    step, spread = discrete(rates, density, dt)
    slow = np.exp(-(omega**2) / (2.0 * damping) * dt)
    assert np.isclose(np.abs(np.linalg.eigvals(step)).max(), slow, rtol=1e-3)
    assert np.isclose(spread[1, 1], 1.0 / (4.0 * damping), rtol=1e-3)  # velocity of a particle in a thick liquid
    assert np.linalg.eigvalsh(spread).min() > -1e-18
    half, added = discrete(rates, density, 0.5 * dt)
    assert np.allclose(half @ half, step, atol=1e-12)
    assert np.allclose(added + half @ added @ half.T, spread, rtol=1e-9, atol=1e-20)
