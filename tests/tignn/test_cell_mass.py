"""A mass that hangs on nodes, in the sub-step engine and in the finite elements."""

import numpy as np
import pytest

from zsdt.scene import BeamShape, Foam, Modulus
from zsdt.solid.bending import Cantilever
from zsdt.solid.solver import BrickSolver, Load
from zsdt.solid.specimen import HungAt, Specimen, SpecimenFem
from zsdt.tignn.cell_energy import CellOptions, CellStart, nominal_constants
from zsdt.tignn.cell_engine import CellEngine

SILICONE = Foam(1070.0, 2.6e5, 0.45, 0.2, 0.02, Modulus.long_term)
SPECIMEN = Specimen(BeamShape(0.1, 0.03, 0.03), 1070.0, 0.01, tip_mass=0.05, hung_at=HungAt.top)
STILL = np.zeros((SPECIMEN.grid.nodes, 3))


def engine():
    constants = nominal_constants(SILICONE.bulk, SILICONE.shear, SILICONE.g1, SILICONE.tau)
    made = CellEngine(constants, CellOptions(start=CellStart.plain, inertia=False, anchor_stress=False))
    made.prepare(SPECIMEN.body(SILICONE, 0.01))
    return made


def straight(made):
    return made.start({"position": made.body.points.copy(), "velocity": STILL.copy()}, STILL)


def test_engine_and_finite_elements_fall_alike_under_a_hung_mass():
    places = np.array([[0.1, 0.015, 0.03]])
    fem = SpecimenFem(SPECIMEN, places).swing(SILICONE, 30, 0.01)[:, 0, 2]
    made = engine()
    made.attach_mass(SPECIMEN.extra_mass)
    state, observe, heights = straight(made), SPECIMEN.observe(places), []
    for _ in range(30):
        heights.append((observe @ state.u[:-1])[0, 2])
        state = made.step(state, STILL, STILL)
    assert np.abs(np.array(heights) - fem).max() < 0.01 * np.abs(fem).max()
    account = made.account(state)
    stored = account["kinetic"] + account["elastic"] + account["dissipated"]
    assert stored == pytest.approx(account["work_of_ports"], rel=2e-3)


def test_without_a_mass_nothing_changes_and_a_mass_can_be_taken_off():
    made, plain = engine(), engine()
    made.attach_mass(SPECIMEN.extra_mass)
    made.attach_mass(np.zeros(SPECIMEN.grid.nodes))
    ours, theirs = made.step(straight(made), STILL, STILL), plain.step(straight(plain), STILL, STILL)
    assert np.array_equal(ours.u, theirs.u) and np.array_equal(made.weight, plain.weight)
    made.attach_mass(SPECIMEN.extra_mass)
    made.prepare(SPECIMEN.body(SILICONE, 0.01))
    assert not made.extra_mass.any()


def test_the_ledger_of_the_solver_closes_with_a_hung_mass():
    solver = BrickSolver(SPECIMEN.grid, SILICONE, None, SPECIMEN.gravity, extra_mass=SPECIMEN.extra_mass)
    solver.set_state(STILL)
    start = solver.frame().balance
    solver.step(Load(), np.zeros(1500))
    end = solver.frame()
    assert end.work_gravity > 1e-3
    assert abs(end.balance - start) < 2e-3 * end.work_gravity


def test_a_thin_beam_with_a_hung_mass_sags_as_beam_theory_says():
    stiff = Foam(20.0, 3e6, 0.0, 0.0, 1.0)
    specimen = Specimen(BeamShape(0.6, 0.05, 0.05), 20.0, 0.025, tip_mass=0.03)
    solver = BrickSolver(specimen.grid, stiff, None, specimen.gravity, extra_mass=specimen.extra_mass)
    solver.relax()
    sag = -solver.displacement[specimen.tip, 2].mean()
    assert sag == pytest.approx(Cantilever(specimen.shape, 20.0, 0.03, poisson=0.0).tip_drop(3e6), rel=0.01)
