"""The cell energy: invariances, agreement of torch and kernel, and the metriplectic structure (Done-when 4)."""

import numpy as np
import pytest
import torch

from tests.tignn.cell_bodies import PITCH, body_of, foam_constants, random_correction
from zsdt.tignn.cell_energy import (
    CellOptions,
    cell_flags,
    cell_strain,
    generic_rates,
    inertial_mass,
    moduli_of,
    start_constants,
    stored_energy,
)
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.cell_kernel import internal_force, new_memory


def energy_of(body, engine, u, held=None):
    relaxed, viscous = torch.as_tensor(engine.moduli.relaxed), torch.as_tensor(engine.moduli.viscous)
    corners = u[torch.as_tensor(body.cells)]
    flags = torch.as_tensor(engine.flags)
    return stored_energy(corners, PITCH, relaxed, viscous, held, engine.correction, flags)


def rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return q if np.linalg.det(q) > 0 else -q


@pytest.mark.parametrize("corrected", [False, True])
def test_kernel_force_is_minus_the_gradient_of_the_torch_energy(corrected):
    body = body_of((4, 3, 2))
    engine = CellEngine(foam_constants(), CellOptions(), random_correction() if corrected else None)
    engine.prepare(body)
    rng = np.random.default_rng(1)
    before, after = (0.004 * rng.standard_normal(body.points.shape) for _ in range(2))
    memory = new_memory(len(engine.tables.cells))
    padded, force = np.zeros((body.nodes + 1, 3)), np.zeros((body.nodes, 3))
    for u in (before, after):  # the second call holds what the memory keeps of the first
        padded[:-1] = u
        internal_force(engine.tables, memory, padded, 0.7, 0.9, engine.corner, force)
    first, second = (cell_strain(torch.as_tensor(u)[torch.as_tensor(body.cells)], PITCH) for u in (before, after))
    held = 0.7 * 0.9 * first - 0.9 * first + 0.9 * second
    u = torch.as_tensor(after).requires_grad_(True)
    energy = energy_of(body, engine, u, (second - held).detach())
    energy.sum().backward()
    assert np.abs(force + u.grad.numpy()).max() < 1e-10 * np.abs(force).max()
    cells = len(body.cells)
    kernel = (memory.elastic + memory.overstress)[:cells] * PITCH**3
    assert np.abs(kernel - energy.detach().numpy()).max() < 1e-10 * kernel.max()


@pytest.mark.parametrize("corrected", [False, True])
def test_energy_knows_no_rigid_motion_and_pulls_nothing_at_rest(corrected):
    body = body_of()
    engine = CellEngine(foam_constants(), CellOptions(), random_correction() if corrected else None)
    engine.prepare(body)
    u = 0.005 * np.random.default_rng(2).standard_normal(body.points.shape)
    turn, shift = rotation(5), np.array([0.3, -2.0, 1.0])
    moved = (body.points + u) @ turn.T + shift - body.points
    energies = [energy_of(body, engine, torch.as_tensor(x)).detach().numpy() for x in (u, moved)]
    np.testing.assert_allclose(energies[1], energies[0], rtol=1e-10)
    assert (energies[0] > 0).all()
    turned_at_rest = body.points @ turn.T + shift
    scale = np.abs(engine.internal_force(body.points + u)).max()
    assert np.abs(engine.internal_force(turned_at_rest)).max() < 1e-10 * scale
    np.testing.assert_allclose(
        engine.internal_force((body.points + u) @ turn.T + shift),
        engine.internal_force(body.points + u) @ turn.T,
        atol=1e-10 * scale,
    )


def test_internal_forces_have_no_sum_and_no_moment():
    body = body_of()
    engine = CellEngine(foam_constants(), CellOptions(), random_correction())
    engine.prepare(body)
    position = body.points + 0.005 * np.random.default_rng(4).standard_normal(body.points.shape)
    force = engine.internal_force(position)
    scale = np.abs(force).sum()
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * scale
    assert np.abs(np.cross(position, force).sum(axis=0)).max() < 1e-13 * scale


def test_forces_of_a_body_do_not_depend_on_another_in_the_same_arrays():
    first, second = body_of((3, 2, 2)), body_of((2, 3, 2))
    both = body_of((3, 2, 2))
    both.points = np.concatenate([first.points, second.points + 1.0])
    both.cells = np.concatenate([first.cells, second.cells + first.nodes])
    both.clamped = np.concatenate([first.clamped, second.clamped])
    both.mass = np.concatenate([first.mass, second.mass])
    rng = np.random.default_rng(9)
    forces, positions = [], [b.points + 0.004 * rng.standard_normal(b.points.shape) for b in (first, second)]
    for body, position in zip((first, second), positions, strict=True):
        engine = CellEngine(foam_constants(), CellOptions(), random_correction())
        engine.prepare(body)
        forces.append(engine.internal_force(position))
    engine.prepare(both)
    together = engine.internal_force(np.concatenate([positions[0], positions[1] + 1.0]))
    scale = np.abs(together).max()
    np.testing.assert_allclose(together, np.concatenate(forces), atol=1e-12 * scale)


def test_uniform_strain_is_seen_by_the_centre_alone():
    body = body_of()
    gradient = 0.1 * np.random.default_rng(6).standard_normal((3, 3))
    u = torch.as_tensor((body.points @ gradient.T)[body.cells])
    strain = cell_strain(u, PITCH).numpy()
    deformation = np.eye(3) + gradient
    green = 0.5 * (deformation.T @ deformation - np.eye(3))
    expected = [green[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(strain[:, :6], np.tile(expected, (len(body.cells), 1)), atol=1e-13)
    np.testing.assert_allclose(strain[:, 6:], 0.0, atol=1e-13)


def test_cube_symmetries_leave_the_energy_alone():
    body = body_of((2, 2, 2))
    engine = CellEngine(foam_constants(), CellOptions(), random_correction())
    engine.constants.boundary[:] = 0.0
    engine.prepare(body)
    engine.flags[:] = 0.0
    one = torch.as_tensor(np.random.default_rng(7).standard_normal((1, 8, 3)) * 0.004)
    relaxed, viscous = torch.as_tensor(engine.moduli.relaxed[:, :1]), torch.as_tensor(engine.moduli.viscous[:, :1])
    corners = np.array([(n & 1, n >> 1 & 1, n >> 2 & 1) for n in range(8)])
    flags = torch.zeros(1, 2, dtype=torch.float64)
    reference = stored_energy(one, PITCH, relaxed, viscous, None, engine.correction, flags)
    for axes in ((1, 0, 2), (2, 1, 0), (0, 2, 1)):
        image = corners[:, axes]
        order = [int(np.flatnonzero((corners == row).all(axis=1))[0]) for row in image]
        turned = one[:, order][:, :, list(axes)]
        energy = stored_energy(turned, PITCH, relaxed, viscous, None, engine.correction, flags)
        np.testing.assert_allclose(energy.detach().numpy(), reference.detach().numpy(), rtol=1e-12)
    for axis in range(3):
        order = [n ^ (1 << axis) for n in range(8)]
        mirrored = one[:, order].clone()
        mirrored[:, :, axis] *= -1
        energy = stored_energy(mirrored, PITCH, relaxed, viscous, None, engine.correction, flags)
        np.testing.assert_allclose(energy.detach().numpy(), reference.detach().numpy(), rtol=1e-12)


def test_degeneracy_of_the_brackets():
    body = body_of()
    moduli = moduli_of(foam_constants(), cell_flags(body.cells, body.clamped))
    rng = np.random.default_rng(8)
    u = torch.as_tensor((0.005 * rng.standard_normal(body.points.shape))[body.cells])
    yielded = cell_strain(u, PITCH) + 0.02 * torch.as_tensor(rng.standard_normal((len(body.cells), 18)))
    flags = torch.as_tensor(cell_flags(body.cells, body.clamped))
    rates = generic_rates(u, yielded, PITCH, moduli, random_correction(), flags)
    friction, energy, entropy = rates["friction"], rates["energy_gradient"], rates["entropy_gradient"]
    # M is symmetric and positive semi-definite, M dE = 0 relative to its terms.
    assert torch.equal(friction, friction.transpose(1, 2)) or torch.allclose(friction, friction.transpose(1, 2))
    eigenvalues = torch.linalg.eigvalsh(friction)
    assert (eigenvalues.min(dim=1).values > -1e-12 * eigenvalues.max(dim=1).values).all()
    vanishing = torch.einsum("cij,cj->ci", friction, energy)
    terms = torch.einsum("cij,cj->ci", friction.abs(), energy.abs())
    assert (vanishing.abs().amax(dim=1) < 1e-12 * terms.amax(dim=1)).all()
    # Entropy production s.M.s is not negative, and it is what the kernel books: 2 W_viscous / tau per cell.
    produced = torch.einsum("ci,cij,cj->c", entropy, friction, entropy)
    held = cell_strain(u, PITCH) - yielded
    booked = stored_energy(u, PITCH, 0 * torch.as_tensor(moduli.relaxed), torch.as_tensor(moduli.viscous), yielded)
    assert (produced >= 0).all()
    np.testing.assert_allclose(produced.numpy(), 2 / moduli.tau * booked.numpy(), rtol=1e-10)
    # The friction moves the dashpots as the kernel does, b' = held / tau (deviator only), and L dS = 0: the canonical
    # bracket acts on (q, p), of which the entropy knows nothing.
    flow = torch.einsum("cij,cj->ci", friction, entropy)[:, :18]
    held[:, :3] -= held[:, :3].mean(dim=1, keepdim=True)
    np.testing.assert_allclose(flow.numpy(), held.numpy() / moduli.tau, rtol=1e-8, atol=1e-10)
    assert float(entropy[:, :18].abs().max()) == 0.0


def test_inertia_keeps_the_mass_and_gains_an_order_in_its_second_moment():
    body = body_of((4, 5, 6))
    mass = inertial_mass(body, 1 / 12)
    assert mass.sum() == pytest.approx(body.mass.sum(), rel=1e-12)
    assert (mass > 0).all()
    np.testing.assert_allclose(inertial_mass(body, 0.0), body.mass, rtol=1e-12)
    height = body.points[:, 2] - body.points[:, 2].mean()
    exact, lumped, moved = 0.3**2 / 12, *((m * height**2).sum() / m.sum() for m in (body.mass, mass))
    assert lumped / exact - 1 == pytest.approx(2 / 6**2, rel=1e-9)  # the trapezoidal rule with six layers
    assert moved / exact - 1 == pytest.approx(2 / 6**3, rel=1e-9)
    # One cell wide: nothing to move to.
    thin = body_of((3, 1, 1))
    cut = thin.points[:, 0] < 0.06
    np.testing.assert_allclose(inertial_mass(thin, 0.1)[cut], thin.mass[cut], rtol=1e-12)


def test_other_materials_scale_the_learned_moduli():
    body = body_of()
    flags = cell_flags(body.cells, body.clamped)
    constants = start_constants(CellOptions())
    constants.card = (1.0, 2.0, 0.5, 0.05)
    same, double = (moduli_of(constants, flags, card) for card in ((1.0, 2.0, 0.5, 0.05), (2.0, 4.0, 0.5, 0.1)))
    np.testing.assert_allclose(double.relaxed, 2 * same.relaxed, rtol=1e-12)
    np.testing.assert_allclose(double.viscous, 2 * same.viscous, rtol=1e-12)
    assert double.tau == pytest.approx(2 * same.tau)
