"""What a rollout must not depend on: numbering, place, batch; and what a turn of the cross-section does to it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.tignn.conftest import batch_in_double, loads_of, make_body, make_trajectory, random_state, unit_model
from zsdt.errors import DataError
from zsdt.graph import graph_of
from zsdt.tignn.augment import section_symmetries, stress_map, turn_batch, turn_load, turn_state
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.tignn.features import STRESS_BASIS
from zsdt.tignn.node_engine import NodeEngine, save_engine
from zsdt.tignn.options import Bracket, TignnOptions
from zsdt.trajectory import Trajectory

SMALL = {"width": 16, "passes": 2, "local_passes": 1}


def calm(options: TignnOptions) -> NodeEngine:
    """Engine whose random increments are small, so that a few steps stay in range."""
    model = unit_model(options)
    with torch.no_grad():
        for p in model.parameters():
            p.mul_(0.6)
    return NodeEngine(model, dtype=torch.float64)


def rolled(engine: NodeEngine, trajectory: Trajectory) -> dict[str, np.ndarray]:
    return roll_out(engine, trajectory, 4).fields


@pytest.mark.parametrize("bracket", list(Bracket))
def test_translation_leaves_the_motion_alone(bracket: Bracket) -> None:
    trajectory = make_trajectory(make_body())
    engine = calm(TignnOptions(**SMALL, bracket=bracket, history=1))
    here = rolled(engine, trajectory)
    shift = np.array([3.0, -2.0, 1.0])
    moved = replace(
        trajectory,
        body=replace(trajectory.body, points=trajectory.body.points + shift),
        fields={**trajectory.fields, "position": trajectory.fields["position"] + shift},
    )
    there = rolled(engine, moved)
    assert np.abs(there["position"] - shift - here["position"]).max() < 1e-12
    assert np.abs(there["stress"] - here["stress"]).max() < 1e-9 * np.abs(here["stress"]).max()


@pytest.mark.parametrize("bracket", list(Bracket))
def test_numbering_does_not_matter(bracket: Bracket) -> None:
    trajectory = make_trajectory(make_body())
    body = trajectory.body
    engine = calm(TignnOptions(**SMALL, bracket=bracket))
    plain = rolled(engine, trajectory)
    order = np.random.default_rng(1).permutation(body.nodes)
    place = np.argsort(order)
    shuffled = replace(
        trajectory,
        body=replace(
            body,
            points=body.points[order],
            clamped=body.clamped[order],
            mass=body.mass[order],
            pairs=np.sort(place[body.pairs], axis=1),
        ),
        fields={name: values[:, order] for name, values in trajectory.fields.items()},
        load=trajectory.load[:, order],
    )
    other = rolled(engine, shuffled)
    for name, values in plain.items():
        assert np.abs(other[name] - values[:, order]).max() < 1e-11 * np.abs(values).max()


def test_the_clamp_holds_and_the_kinematics_are_the_trapezoid() -> None:
    trajectory = make_trajectory(make_body())
    fields = rolled(calm(TignnOptions(**SMALL)), trajectory)
    position, velocity, clamped = fields["position"], fields["velocity"], trajectory.body.clamped
    assert np.abs(position[:, clamped] - trajectory.body.points[clamped]).max() < 1e-12
    mean = 0.5 * (velocity[1:] + velocity[:-1])[:, ~clamped]
    steps = np.diff(position, axis=0)[:, ~clamped]
    assert np.abs(steps - trajectory.body.frame_dt * mean).max() < 1e-14


def test_the_symmetries_form_the_group_of_the_square() -> None:
    turns = section_symmetries()
    assert len(np.unique(turns.round(6), axis=0)) == 8
    for a in turns:
        assert np.allclose(a @ a.T, np.eye(3))
        assert any(np.allclose(a @ b, np.eye(3)) for b in turns)
        for b in turns:
            assert any(np.allclose(a @ b, c) for c in turns)
            assert np.allclose(stress_map(a @ b), stress_map(a) @ stress_map(b))


def test_a_turn_keeps_every_scalar_of_a_state() -> None:
    body = make_body()
    state = random_state(body, TignnOptions(history=2))
    basis = torch.tensor(STRESS_BASIS)
    for turn in section_symmetries():
        turned = turn_state(state, turn)
        coordinates = [s @ basis.T for s in (state.stress, turned.stress)]
        assert torch.allclose(coordinates[0][:, 0], coordinates[1][:, 0])
        assert torch.allclose(coordinates[0].norm(dim=1), coordinates[1].norm(dim=1))
        assert torch.allclose(turned.velocity[:, 0], state.velocity[:, 0])
        # power of the stress on a velocity gradient made of the same vectors: s : (v v')
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        power = [
            sum(
                (1 if i == j else 2) * s.stress[:, k] * s.velocity[:, i] * s.velocity[:, j]
                for k, (i, j) in enumerate(pairs)
            )
            for s in (state, turned)
        ]
        assert torch.allclose(*power)


@pytest.mark.parametrize("bracket", list(Bracket))
def test_the_symmetric_average_commutes_with_every_turn(bracket: Bracket) -> None:
    body = make_body()
    options = TignnOptions(**SMALL, bracket=bracket, history=1, symmetric=True)
    model, state, (load, load_next) = unit_model(options), random_state(body, options), loads_of(body)
    batch = batch_in_double(body)
    batch = replace(batch, gravity=torch.randn(body.nodes, 3).double())
    with torch.inference_mode():
        straight = model(batch, state, load, load_next).state
        for turn in section_symmetries():
            turned = model(
                turn_batch(batch, turn), turn_state(state, turn), turn_load(load, turn), turn_load(load_next, turn)
            ).state
            expected = turn_state(straight, turn)
            for name in ("displacement", "velocity", "stress", "increments"):
                a, b = getattr(turned, name), getattr(expected, name)
                assert (a - b).abs().max() <= 1e-11 * b.abs().max()


def test_saved_and_loaded_predicts_the_same(tmp_path: Path) -> None:
    trajectory = make_trajectory(make_body())
    engine = NodeEngine(unit_model(TignnOptions(**SMALL, rank=3)).float())
    save_engine(engine.model, tmp_path)
    first, second = (roll_out(e, trajectory, 3).fields for e in (engine, load_engine(tmp_path)))
    assert all(np.array_equal(first[name], second[name]) for name in first)


def test_a_broken_artifact_gives_one_sentence(tmp_path: Path) -> None:
    save_engine(unit_model(TignnOptions(**SMALL)), tmp_path)
    (tmp_path / "weights.pt").write_bytes(b"half")
    with pytest.raises(DataError, match="train it again"):
        load_engine(tmp_path)


def test_an_unprepared_engine_says_so() -> None:
    engine = NodeEngine(unit_model(TignnOptions(**SMALL)))
    with pytest.raises(DataError, match="prepare"):
        _ = engine.batch


def test_a_body_of_loose_nodes_is_a_graph_too() -> None:
    body = replace(make_body((2, 1, 1)), pairs=np.zeros((0, 2), np.int64))
    assert len(graph_of(body.nodes, body.pairs).neighbour) == 0
    fields = rolled(calm(TignnOptions(**SMALL)), make_trajectory(body))
    assert np.isfinite(fields["stress"]).all()
