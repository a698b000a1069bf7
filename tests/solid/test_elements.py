"""The two hexahedra against what is known without a mesh: homogeneous states, rotations, relaxation, energy."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsdt.scene import Foam
from zsdt.solid import codegen
from zsdt.solid.element import Element, elastic_constants, internal_force
from zsdt.solid.mesh import BrickMesh
from zsdt.solid.solver import BrickSolver, Load, SolverOptions

BOTH = [Element.stabilised, Element.full]
ELASTIC = Foam(g1=0.0)


def cauchy(gradient, material, bulk_part=1.0, shear_part=1.0):
    """Cauchy stress [Pa] of a St. Venant-Kirchhoff material as a 3x3 matrix."""
    e = 0.5 * (gradient.T @ gradient - np.eye(3))
    dev = e - np.trace(e) / 3.0 * np.eye(3)
    s = bulk_part * material.bulk * np.trace(e) * np.eye(3) + 2.0 * shear_part * material.shear * dev
    return gradient @ s @ gradient.T / np.linalg.det(gradient)


def six(matrix):
    """11 22 33 12 13 23."""
    return matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def still(mesh, element, material=ELASTIC, **options):
    """A solver whose nodes are all held."""
    held = np.zeros((mesh.nodes, 3), bool)
    return BrickSolver(mesh, material, SolverOptions(element=element, **options), free=held)


def test_committed_kernels_are_what_the_generator_writes():
    assert Path(codegen.__file__).with_name("element_kernels.py").read_text() == codegen.generate()


@pytest.mark.parametrize("element", BOTH)
def test_patch_of_elements_reproduces_a_homogeneous_deformation(element):
    """Boundary nodes follow x = F X; the free inner node must end at F X to 1e-10 of the displacement, with the
    closed-form stress at every node."""
    mesh = BrickMesh((2, 2, 2), 0.05)
    points = mesh.grid.points
    gradient = np.eye(3) + 0.15 * np.random.default_rng(1).standard_normal((3, 3))
    exact = points @ (gradient - np.eye(3)).T
    u = exact.copy()
    inner = 13
    u[inner] += [0.006, -0.004, 0.005]
    constants = elastic_constants(ELASTIC, mesh.edge)
    for _ in range(12):
        force = internal_force(mesh, constants, element, u)[inner]
        tangent = np.zeros((3, 3))
        for c in range(3):
            v = u.copy()
            v[inner, c] += 1e-7
            tangent[:, c] = (internal_force(mesh, constants, element, v)[inner] - force) / 1e-7
        u[inner] -= np.linalg.solve(tangent, force)
    assert np.abs(u - exact).max() < 1e-10 * np.abs(exact).max()
    solver = still(mesh, element)
    solver.set_state(u)
    expected = six(cauchy(gradient, ELASTIC))
    assert np.abs(solver.frame().stress - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("element", BOTH)
def test_rigid_rotation_gives_no_force_and_no_stress(element):
    mesh = BrickMesh((3, 2, 2), 0.025)
    turn = Rotation.from_rotvec([0.7, -1.9, 0.4]).as_matrix()
    solver = still(mesh, element)
    solver.set_state(mesh.grid.points @ (turn - np.eye(3)).T + [0.1, 0.2, -0.3])
    assert np.abs(solver.frame().stress).max() < 1e-9 * ELASTIC.young
    force = internal_force(mesh, elastic_constants(ELASTIC, mesh.edge), element, solver.displacement)
    assert np.abs(force).max() < 1e-11 * ELASTIC.young * mesh.edge**2


@pytest.mark.parametrize("element", BOTH)
def test_forces_are_the_gradient_of_the_energy_that_the_account_books(element):
    """Covers the stabilisation: hourglass modes carry energy, and the forces derive from exactly that energy."""
    mesh = BrickMesh((2, 1, 2), 0.05)
    rng = np.random.default_rng(3)
    u, direction = (0.004 * rng.standard_normal((mesh.nodes, 3)) for _ in range(2))
    solver = still(mesh, element)

    def energy(step):
        solver.set_state(u + step * direction)
        return solver.frame().elastic

    slope = (8.0 * (energy(1e-3) - energy(-1e-3)) - (energy(2e-3) - energy(-2e-3))) / 12e-3
    force = internal_force(mesh, elastic_constants(ELASTIC, mesh.edge), element, u)
    assert slope == pytest.approx((force * direction).sum(), rel=1e-9)


@pytest.mark.parametrize("element", BOTH)
@pytest.mark.parametrize("shear", [1e-3, 0.3])
def test_single_element_relaxes_as_the_closed_form(element, shear):
    """Simple shear applied within one step and held: S(t) = K tr E + 2 mu (1 - g1 + g1 exp(-t/tau)) dev E."""
    material = Foam()
    mesh = BrickMesh((1, 1, 1), 0.025)
    solver = still(mesh, element, material, min_stretch=0.0)
    solver.set_state(np.zeros((8, 3)))
    gradient = np.eye(3)
    gradient[0, 2] = shear
    solver.displacement = mesh.grid.points @ (gradient - np.eye(3)).T
    worst = 0.0
    time = -0.5 * solver.dt  # the jump lies in the middle of the first step
    for steps in (1, 40, 200, 400, 800):
        solver.step(Load(), np.zeros(steps))
        time += steps * solver.dt
        left = 1.0 - material.g1 + material.g1 * np.exp(-time / material.tau)
        expected = six(cauchy(gradient, material, shear_part=left))
        worst = max(worst, np.abs(solver.frame().stress - expected).max() / np.abs(expected).max())
    assert worst < 1e-5


@pytest.mark.parametrize("element", BOTH)
def test_dissipation_of_a_relaxing_element_is_what_its_energy_loses(element):
    """Held strain does no work, so stored and dissipated energy have a constant sum (hourglass modes included)."""
    mesh = BrickMesh((1, 1, 1), 0.025)
    solver = still(mesh, element, Foam())
    solver.set_state(np.zeros((8, 3)))
    solver.displacement = 0.001 * np.random.default_rng(5).standard_normal((8, 3))
    solver.step(Load(), np.zeros(1))
    first = solver.frame()
    solver.step(Load(), np.zeros(3000))
    last = solver.frame()
    lost = first.elastic - last.elastic
    assert lost > 0.1 * first.elastic
    assert last.dissipated - first.dissipated == pytest.approx(lost, rel=1e-5)
    u = solver.displacement
    solver.set_state(u)  # fully relaxed by definition
    assert last.elastic == pytest.approx(solver.frame().elastic, rel=1e-6)


@pytest.mark.parametrize("element", BOTH)
def test_critical_step_bounds_that_of_a_mesh(element):
    """Highest frequency of a free 2x2x2 mesh by power iteration: below the element bound, not far."""
    mesh = BrickMesh((2, 2, 2), 0.025)
    solver = BrickSolver(mesh, ELASTIC, SolverOptions(element=element))
    constants = elastic_constants(ELASTIC, mesh.edge)
    u = 1e-7 * np.random.default_rng(0).standard_normal((mesh.nodes, 3))
    highest = 0.0
    for _ in range(400):
        acceleration = internal_force(mesh, constants, element, u) / solver.mass[:, None]
        highest = np.linalg.norm(acceleration) / np.linalg.norm(u)
        u = 1e-7 * acceleration / np.linalg.norm(acceleration)
    assert 0.7 < solver.critical_dt / (2.0 / np.sqrt(highest)) <= 1.0 + 1e-6
