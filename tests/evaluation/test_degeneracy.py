"""What the tables say about a bracket's promises: kept by the exact and the sub-step form, broken by the soft one."""

import numpy as np
import pytest
import torch

from zsdt.evaluation.baselines import StaticBaseline
from zsdt.evaluation.degeneracy import degeneracy
from zsdt.graph import brick_grid
from zsdt.scene import Foam
from zsdt.tignn.cell_energy import nominal_constants
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.features import Scales
from zsdt.tignn.model import NodeModel
from zsdt.tignn.node_engine import NodeEngine
from zsdt.tignn.options import Bracket, TignnOptions
from zsdt.trajectory import Body, Trajectory

RESIDUALS = ("probe_energy_residual", "probe_entropy_leak", "probe_energy_leak")


@pytest.fixture
def pressed():
    """A small foam beam, at rest at first, under a load that grows."""
    grid = brick_grid((3, 1, 1), 0.05)
    count = len(grid.points)
    mass = np.full(count, 18.44 * 0.05**3 * 3 / count)
    body = Body(grid.points, grid.pairs, grid.points[:, 0] == 0, mass, 1 / 60, 0.05, cells=grid.cells, material=Foam())
    fields = {
        "position": np.repeat(grid.points[None], 6, axis=0),
        "velocity": np.zeros((6, count, 3)),
        "stress": np.zeros((6, count, 6)),
    }
    load = np.zeros((6, count, 3))
    load[:, -1, 2] = -0.05 * np.arange(6)
    return Trajectory(body, np.arange(6) / 60, fields, load)


def node_engine(bracket):
    torch.manual_seed(0)
    options = TignnOptions(bracket=bracket, passes=2, width=16)
    scales = Scales(strain=0.2, rate=20.0, frame_dt=1 / 60, node_volume=1.25e-4)
    return NodeEngine(NodeModel(options, scales))


def test_exact_keeps_its_promises_and_soft_does_not(pressed):
    exact, soft = (degeneracy(node_engine(b), pressed) for b in (Bracket.exact, Bracket.soft))
    assert max(exact[name] for name in RESIDUALS) < 1e-12 and exact["probe_entropy_production"] >= 0.0
    assert max(soft[name] for name in RESIDUALS) > 1e-6


def test_the_sub_step_form_keeps_its_promises(pressed):
    foam = Foam()
    engine = CellEngine(nominal_constants(foam.bulk, foam.shear, foam.g1, foam.tau))
    found = degeneracy(engine, pressed)
    assert max(found[name] for name in RESIDUALS) < 1e-12 and found["probe_entropy_production"] >= 0.0


def test_what_has_no_bracket_promises_nothing(pressed):
    assert degeneracy(StaticBaseline(), pressed) == {}
    assert degeneracy(node_engine(Bracket.none), pressed) == {}


def test_probing_leaves_the_engine_as_it_was(pressed):
    engine = node_engine(Bracket.exact)
    before = {k: v.clone() for k, v in engine.model.state_dict().items()}
    degeneracy(engine, pressed)
    assert all(v.dtype == torch.float32 and torch.equal(v, before[k]) for k, v in engine.model.state_dict().items())
