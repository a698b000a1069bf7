"""The coarse solver behind the interface of an engine."""

from dataclasses import replace

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.solid.dataset import simulate
from zsdt.solid.engine import CoarseFem, Start
from zsdt.solid.loads import History, LoadCase, Regime
from zsdt.solid.mesh import Face
from zsdt.solid.sampler import Job, SynthesisOptions

OPTIONS = SynthesisOptions(mesh=0.05, hand_duration=0.4, hand_frame_dt=0.01)


@pytest.fixture(scope="module")
def truth():
    """A 40x10x20 cm beam under a slow side push, computed on the mesh of 5 cm itself."""
    case = LoadCase(Face.front, (0.3, 0.4), (0.05, 0.15), 0.5, History("ramps", (0.05, 0.35), (0.0, 1.0)))
    return simulate(Job("test", 0, (40, 10, 20), Regime.hand), case, OPTIONS)


def predicted(engine, truth):
    """Fields of every frame, and the last state."""
    engine.prepare(truth.body)
    state = engine.start(truth.at(0), truth.load[0])
    frames = [engine.read(state)]
    for k in range(1, truth.frames):
        state = engine.step(state, truth.load[k - 1], truth.load[k])
        frames.append(engine.read(state))
    return {name: np.stack([f[name] for f in frames]) for name in frames[0]}, state


@pytest.mark.parametrize("start", list(Start))
def test_same_mesh_and_same_loads_give_the_same_motion(truth, start):
    """Loads pass through nodal forces at frames, linear in between, instead of a pressure at every step."""
    engine = CoarseFem(0.05, start=start, anchored=False)
    fields, state = predicted(engine, truth)
    moved = truth.fields["position"] - truth.fields["position"][0]
    assert np.abs(moved).max() > 2e-3
    own = fields["position"] - fields["position"][0]
    assert np.linalg.norm(own - moved) < 5e-3 * np.linalg.norm(moved)
    stress = truth.fields["stress"]
    assert np.linalg.norm(fields["stress"] - stress) < 5e-3 * np.linalg.norm(stress)
    account = engine.account(state)
    assert account["work_load"] == pytest.approx(truth.ledger["work_load"][-1], rel=1e-2)


def test_anchored_engine_is_right_at_the_first_frame(truth):
    engine = CoarseFem(0.1)
    engine.prepare(truth.body)
    given = truth.at(0)
    first = engine.read(engine.start(given, truth.load[0]))
    np.testing.assert_allclose(first["position"], given["position"], atol=1e-12)
    np.testing.assert_allclose(first["stress"], given["stress"], atol=1e-6)


def test_coarser_mesh_predicts_worse_but_predicts(truth):
    fields, _ = predicted(CoarseFem(0.1), truth)
    moved = truth.fields["position"] - truth.fields["position"][0]
    error = np.linalg.norm(fields["position"] - truth.fields["position"]) / np.linalg.norm(moved)
    assert 1e-3 < error < 0.1


def test_mesh_that_does_not_fit_is_refused(truth):
    odd = replace(truth.body, points=truth.body.points * [7 / 8, 1.0, 1.0])
    assert not CoarseFem(0.1).applies_to(odd)
    assert CoarseFem(0.05).applies_to(odd)
    with pytest.raises(OptionError, match="do not fill"):
        CoarseFem(0.1).prepare(odd)
    with pytest.raises(OptionError, match="material"):
        CoarseFem(0.05).prepare(replace(truth.body, material=None))


def test_rejected_run_goes_on_as_nan(truth, caplog):
    engine = CoarseFem(0.05)
    engine.prepare(truth.body)
    state = engine.start(truth.at(0), truth.load[0])
    crush = np.zeros_like(truth.load[0])
    crush[truth.body.points[:, 0] > 0.4 - 1e-9, 0] = -50.0
    state = engine.step(state, crush, crush)
    assert state.failed == "collapse" and "stops predicting" in caplog.text
    assert all(np.isnan(v).all() for v in engine.read(state).values())
