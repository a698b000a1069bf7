"""Coarse SPH as an engine: fields carried exactly where they can be, rest stays rest, momentum, loads, refusals."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.fluid.coarsening import coarsen, interpolate
from zsdt.fluid.engine import CoarseSph
from zsdt.fluid.sampling import fill
from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselShape
from zsdt.tignn.engine import Engine, roll_out
from zsdt.trajectory import Body, Trajectory

SHAPE = VesselShape(heights=[0.0, 0.1], radii=[0.03, 0.03])
LEVEL = 0.045


@pytest.fixture(scope="module")
def body():
    filled = fill(Vessel(SHAPE), LEVEL, 350, np.random.default_rng(0))
    n = len(filled.points)
    return Body(
        points=filled.points,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(n, bool),
        mass=np.full(n, 1261.0 * filled.spacing**3),
        frame_dt=0.004,
        pitch=filled.spacing,
        liquid=Liquid(),
        vessel=SHAPE,
    )


def trajectory(body, velocity, frames, load=None):
    """Truth of which only the first frame is used."""
    n = body.nodes
    fields = {
        "position": np.broadcast_to(body.points, (frames, n, 3)).copy(),
        "velocity": np.broadcast_to(velocity, (frames, n, 3)).copy(),
        "internal_energy": np.full((frames, n, 1), 0.02),
    }
    load = np.zeros((frames, n, 3)) if load is None else load
    return Trajectory(body, 0.004 * np.arange(frames), fields, load)


def test_linear_fields_are_interpolated_almost_exactly():
    rng = np.random.default_rng(1)
    particles = fill(Vessel(SHAPE), LEVEL, 200, rng)
    targets = fill(Vessel(SHAPE), LEVEL, 300, rng).points
    slope = rng.normal(size=(3, 2))
    values = particles.points @ slope + [1.0, -2.0]
    found, seconds = interpolate(targets, particles.points, values, particles.spacing)
    error = np.abs(found - (targets @ slope + [1.0, -2.0]))
    assert error.max() < 0.15 * particles.spacing * np.abs(slope).max() * 3 and seconds > 0
    constant, _ = interpolate(targets, particles.points, np.ones((len(particles.points), 1)), particles.spacing)
    np.testing.assert_allclose(constant, 1.0, atol=1e-9)


def test_fewer_particles_fill_the_same_shape(body):
    """Of a tilted surface, which no level describes: same centroid, same height of the surface, same density."""
    tilted = body.points * [1, 1, 1]
    tilted[:, 2] *= 1.0 + 6.0 * tilted[:, 0]
    count = body.nodes // 3
    spacing = body.pitch * (body.nodes / count) ** (1 / 3)
    coarse = coarsen(tilted, count, Vessel(SHAPE), spacing, 1.5 * spacing)
    assert coarse.shape == (count, 3)
    np.testing.assert_allclose(coarse.mean(axis=0), tilted.mean(axis=0), atol=0.1 * spacing)
    slope = np.polyfit(*tilted[:, [0, 2]].T, 1)[0]
    assert np.polyfit(*coarse[:, [0, 2]].T, 1)[0] == pytest.approx(slope, abs=0.04)
    assert Vessel(SHAPE).distance(coarse).min() > 0.2 * spacing


def test_rest_stays_at_rest(body):
    engine = CoarseSph(1.4)
    assert isinstance(engine, Engine) and engine.applies_to(body) and engine.name == "sph_1.4dx"
    rolled = roll_out(engine, trajectory(body, np.zeros(3), 26))
    assert rolled.diverged_at is None
    moved = np.linalg.norm(rolled.fields["position"][-1] - body.points, axis=1)
    assert moved.mean() < 0.1 * body.pitch
    assert np.abs(rolled.fields["velocity"][-1]).max() < 0.02
    assert rolled.account["kinetic"][-1] < 1e-4 * body.mass.sum()
    assert (rolled.graph_milliseconds > 0).all() and (rolled.graph_milliseconds < rolled.milliseconds).all()


def test_tracers_start_with_the_momentum_that_is_given_and_heat_up(body):
    velocity = np.array([0.3, -0.1, 0.0])
    rolled = roll_out(CoarseSph(1.4), trajectory(body, velocity, 11))
    np.testing.assert_array_equal(rolled.fields["velocity"][0], np.broadcast_to(velocity, (body.nodes, 3)))
    np.testing.assert_allclose(rolled.account["kinetic"][0], 0.5 * body.mass.sum() * 0.1, rtol=1e-9)
    first = rolled.fields["position"][1].mean(axis=0) - body.points.mean(axis=0)
    assert 0.3 < first @ velocity / (0.004 * velocity @ velocity) < 1.0  # walls begin to hold it back
    assert np.all(Vessel(SHAPE).distance(rolled.fields["position"].reshape(-1, 3)) > 0.05 * body.pitch)
    # The coarse account closes, and the tracers carry its heat.
    account = rolled.account
    total = account["kinetic"] + account["potential"] + account["internal"] - account["work_of_ports"]
    assert np.ptp(total) < 0.05 * account["kinetic"][0]
    heat = (body.mass[:, None] * (rolled.fields["internal_energy"][-1] - 0.02)).sum()
    assert heat == pytest.approx(account["internal"][-1] - account["internal"][0], rel=0.1)


def test_load_is_the_push_of_an_accelerated_vessel(body):
    """Two frames of a sideways load: walls hold most of the liquid, the rest goes on, booked as work."""
    load = np.zeros((4, body.nodes, 3))
    load[:, :, 0] = 5.0 * body.mass
    rolled = roll_out(CoarseSph(1.4), trajectory(body, np.zeros(3), 4, load))
    gained = rolled.fields["velocity"][-1].mean(axis=0)
    assert 0.1 * 5.0 * 0.012 < gained[0] < 5.0 * 0.012 and abs(gained[1]) < 0.2 * gained[0]
    assert rolled.account["work_of_ports"][-1] > rolled.account["kinetic"][-1] > 0


def test_bodies_that_it_cannot_predict_are_refused(body):
    with pytest.raises(OptionError, match="finer than the given"):
        CoarseSph(0.8)
    with pytest.raises(OptionError, match="20 coarse particles"):
        CoarseSph(3.0).prepare(body)
    assert not CoarseSph(3.0).applies_to(body)
