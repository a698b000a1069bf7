"""A rollout hands every engine the same loads, stops where numbers end, and loads only engines that it knows."""

import json

import numpy as np
import pytest

from zsdt.errors import DataError, RunRejected
from zsdt.graph import brick_grid
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.trajectory import Body, Trajectory


class FreeFall:
    """Exact free flight of every node under its load: x(t) is a cubic where the load is linear in time."""

    name = "free_fall"

    def prepare(self, body):
        self.dt, self.mass = body.frame_dt, body.mass[:, None]

    def start(self, fields, load):
        return fields["position"], fields["velocity"], 0

    def step(self, state, load, load_next):
        position, velocity, frame = state
        now, change = load / self.mass, (load_next - load) / self.mass
        position = position + self.dt * velocity + self.dt**2 * (now / 2 + change / 6)
        return position, velocity + self.dt * (now + change / 2), frame + 1

    def read(self, state):
        return {"position": state[0], "velocity": state[1]}

    def account(self, state):
        return {"kinetic": float(0.5 * (self.mass * state[1] ** 2).sum())}


class Exploding(FreeFall):
    """As `FreeFall`, but its fourth frame is not a number."""

    def read(self, state):
        fields = super().read(state)
        return {k: v * np.nan for k, v in fields.items()} if state[2] == 3 else fields


class Refusing(FreeFall):
    """An engine that finds its first state out of range."""

    def start(self, fields, load):
        raise RunRejected("layers", "The liquid is too shallow for its particles.")


@pytest.fixture
def pushed():
    """A 2 x 1 x 1 grid of free nodes pushed by a force that grows linearly: x = f t^3 / 6 m in closed form."""
    grid = brick_grid((2, 1, 1), 0.05)
    count = len(grid.points)
    body = Body(grid.points, grid.pairs, np.zeros(count, bool), np.full(count, 0.5), frame_dt=0.1, pitch=0.05)
    times = np.arange(8) * 0.1
    load = np.broadcast_to(times[:, None, None] * np.array([1.0, 0.0, -2.0]), (8, count, 3)).copy()
    position = grid.points + times[:, None, None] ** 3 / 6 * np.array([2.0, 0.0, -4.0])
    velocity = np.broadcast_to(times[:, None, None] ** 2 / 2 * np.array([2.0, 0.0, -4.0]), position.shape).copy()
    return Trajectory(body, times, {"position": position, "velocity": velocity}, load)


def test_loads_reach_the_engine_frame_by_frame(pushed):
    rollout = roll_out(FreeFall(), pushed)
    np.testing.assert_allclose(rollout.fields["position"], pushed.fields["position"], atol=1e-14)
    np.testing.assert_allclose(rollout.fields["velocity"], pushed.fields["velocity"], atol=1e-14)
    kinetic = 0.25 * (pushed.fields["velocity"] ** 2).sum(axis=(1, 2))
    np.testing.assert_allclose(rollout.account["kinetic"], kinetic, rtol=1e-12, atol=1e-18)
    assert rollout.milliseconds.shape == (7,)
    assert rollout.diverged_at is None


def test_a_number_that_ends_is_named_and_not_hidden(pushed):
    rollout = roll_out(Exploding(), pushed)
    assert rollout.diverged_at == 3
    assert np.isfinite(rollout.fields["position"][:3]).all()
    assert np.isnan(rollout.fields["position"][3:]).all()
    assert np.isnan(rollout.account["kinetic"][3:]).all()


@pytest.mark.parametrize("card, sentence", [(None, "engine.json is missing"), ({"kind": "oracle"}, "'oracle'")])
def test_a_folder_without_a_known_engine_says_so(tmp_path, card, sentence):
    if card is not None:
        (tmp_path / "engine.json").write_text(json.dumps(card))
    with pytest.raises(DataError, match=sentence):
        load_engine(tmp_path)


def test_an_engine_that_refuses_the_first_state_has_diverged_at_once_and_stops_nobody(pushed):
    rollout = roll_out(Refusing(), pushed)
    assert rollout.diverged_at == 1
    np.testing.assert_array_equal(rollout.fields["position"][0], pushed.fields["position"][0])
    assert np.isnan(rollout.fields["position"][1:]).all() and np.isnan(rollout.milliseconds).all()
