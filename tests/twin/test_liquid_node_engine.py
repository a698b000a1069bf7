"""The node form as the engine of a glass twin: frames that are no whole number of its steps, and its ports."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.tignn.liquid_bodies import make_liquid
from tests.twin.liquid_scenes import RADIUS, SeenSurface, liquid
from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.evaluation.glass_twin_cases import load_glass_engine
from zsdt.planning.choices import GlassChoice
from zsdt.tignn.liquid_engine import LiquidEngine, LiquidRun, save_engine
from zsdt.tignn.liquid_features import LiquidScales, LiquidState
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.options import Bracket, TignnOptions
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.twin.glass_twin import GlassTwin
from zsdt.twin.liquid_assimilation import LiquidAssimilationOptions, LiquidMethod
from zsdt.twin.liquid_node_engine import LiquidNodeEngine, twin_engine_of

torch.set_num_threads(1)
FRAME = 1 / 60
WAVE = 2.0 * np.pi * 3.0  # rad/s, of a sloshing glass


def network(step: float = 0.004, seed: int = 0) -> LiquidEngine:
    """Random weights; `step` [s]."""
    torch.manual_seed(seed)
    options = TignnOptions(width=8, passes=1, rank=1, bracket=Bracket.soft)
    return LiquidEngine(LiquidModel(options, LiquidScales(frame_dt=step, d_velocity=1e-4, d_energy=1e-4)))


class Known(LiquidEngine):
    """Steps of a motion that is known: a constant acceleration [m/s2] beside that of the load, or a swing about the
    beginning. Its positions follow by the trapezoid, as those of the network."""

    def __init__(self, step: float, acceleration: np.ndarray | None = None):
        super().__init__(network(step).model)
        self.acceleration = acceleration

    def step(self, state: LiquidRun, load: np.ndarray, load_next: np.ndarray) -> LiquidRun:
        dt, now = self.body.frame_dt, state.state
        if self.acceleration is None:
            away = now.position - self._points
            velocity = now.velocity * np.cos(WAVE * dt) - WAVE * away * np.sin(WAVE * dt)
            position = self._points + away * np.cos(WAVE * dt) + now.velocity / WAVE * np.sin(WAVE * dt)
        else:
            velocity = now.velocity + dt * (self.acceleration + 0.5 * (load + load_next) / self.body.mass)
            position = now.position + 0.5 * dt * (now.velocity + velocity)
        new = LiquidState(position, velocity, now.energy + dt)
        return LiquidRun(new, self._account(new, state.account, None))


def begun(steps: LiquidEngine, frame_dt: float = FRAME, speed: float = 0.0) -> tuple[LiquidNodeEngine, object]:
    body = replace(make_liquid(), frame_dt=frame_dt)
    engine = LiquidNodeEngine(steps)
    engine.prepare(body)
    velocity = np.tile([speed, 0.0, 0.0], (body.nodes, 1))
    return engine, engine.start({"position": body.points, "velocity": velocity}, np.zeros_like(body.points))


@pytest.mark.parametrize("frame_dt", [FRAME, 1 / 240, 0.004, 0.003])
def test_free_flight_arrives_to_rounding_whatever_the_frame(frame_dt: float) -> None:
    fall = np.array([0.2, 0.0, 0.3])
    engine, state = begun(Known(0.004, fall), frame_dt, speed=0.01)
    first, count = state.position, round(0.02 / frame_dt)
    none = np.zeros_like(first)
    for _ in range(count):
        state = engine.step(state, none, none)
    t = count * frame_dt
    np.testing.assert_allclose(state.velocity - ([0.01, 0.0, 0.0] + t * fall), 0.0, atol=1e-12)
    inside = engine.steps.body.vessel.distance(state.position) > 1.01 * engine.steps.body.clearance
    assert inside.sum() > 20
    true = first + t * np.array([0.01, 0.0, 0.0]) + 0.5 * t**2 * fall
    np.testing.assert_allclose(state.position[inside], true[inside], atol=1e-12)
    np.testing.assert_allclose(state.energy, t, rtol=1e-9)


def test_a_push_of_the_vessel_is_given_whole_and_in_its_own_frame() -> None:
    engine, state = begun(Known(0.004, np.zeros(3)))
    load = engine.body.mass[:, None] * np.array([1.5, 0.0, 0.0])
    pushed = engine.step(state, np.zeros_like(load), 2.0 * load)  # grows linearly from nothing
    np.testing.assert_allclose(pushed.velocity[:, 0], 1.5 * FRAME, rtol=1e-12)
    np.testing.assert_array_equal(engine.step(pushed, 0 * load, 0 * load).velocity, pushed.velocity)


def swing_error(step: float) -> float:
    """Of a swing of 3 Hz after a third of a second [share of its speed]; the steps themselves are exact."""
    engine, state = begun(Known(step), speed=0.02)
    none, count = np.zeros_like(state.position), 20
    for _ in range(count):
        state = engine.step(state, none, none)
    t = count * FRAME
    away = state.position - engine.body.points
    middle = engine.steps.body.vessel.distance(engine.body.points) > 0.01  # the swing keeps clear of the wall
    ahead = away[middle, 0] * WAVE - 0.02 * np.sin(WAVE * t)
    faster = state.velocity[middle, 0] - 0.02 * np.cos(WAVE * t)
    return float(np.hypot(ahead, faster).max()) / 0.02


def test_a_swing_arrives_with_an_error_of_second_order_in_the_step() -> None:
    counts = np.array([2.5, 5.5, 11.5])  # steps of a frame
    errors = [swing_error(FRAME / count) for count in counts]
    assert -np.diff(np.log(errors)) / np.diff(np.log(counts)) == pytest.approx([2.0, 2.0], abs=0.1)
    assert swing_error(0.004) < 0.02


def test_networks_step_by_their_own_length_and_leave_what_they_are_given() -> None:
    engine, state = begun(network())
    assert (engine.whole, engine.steps.body.frame_dt) == (4, 0.004) and engine.part == pytest.approx(1 / 6)
    before = state.position.copy()
    none = np.zeros_like(before)
    first, second = (engine.step(state, none, none) for _ in range(2))
    np.testing.assert_array_equal(state.position, before)
    np.testing.assert_array_equal(first.position, second.position)
    assert engine.steps.body.vessel.distance(first.position).min() >= 0.999 * engine.steps.body.clearance
    whole = network()
    whole.prepare(replace(engine.body, frame_dt=0.004))
    run = whole.start(engine.read(state), none)
    for _ in range(4):
        run = whole.step(run, none, none)
    shared = LiquidNodeEngine(engine.steps)  # the same network, for another liquid
    shared.prepare(replace(make_liquid(radius=0.018), frame_dt=FRAME))
    np.testing.assert_array_equal(engine.step(state, none, none).position, first.position)
    four, _ = begun(network(), 0.016)
    np.testing.assert_array_equal(four.step(state, none, none).position, run.state.position)


def test_what_leaves_its_range_is_refused_with_a_sentence_and_ends_the_twin() -> None:
    wild = network()
    wild.model.scales.d_velocity = 1e4
    engine, state = begun(wild)
    none = np.zeros_like(state.position)
    with pytest.raises(RunRejected, match="does not carry this liquid: train it longer"):
        for _ in range(20):
            state = engine.step(state, none, none)
    twin = GlassTwin(LiquidNodeEngine(wild), None, replace(make_liquid(), frame_dt=FRAME))
    twin.begin()
    with pytest.raises(RunRejected, match="does not carry"):
        for _ in range(20):
            twin.predict()


def test_ports_book_their_work_and_rest_turns_motion_into_heat() -> None:
    engine, state = begun(network(), speed=0.1)
    rng = np.random.default_rng(0)
    move, push = 1e-4 * rng.standard_normal((2, *state.position.shape))
    new, work = engine.displace(state, move, push)
    gained = {name: engine.account(new)[name] - engine.account(state)[name] for name in ("kinetic", "potential")}
    assert work == pytest.approx(sum(gained.values())) and gained["kinetic"] != 0.0
    assert engine.displace(state, 0 * move, 0 * push) == (state, 0.0)
    still = engine.come_to_rest(state)
    a, b = engine.account(state), engine.account(still)
    assert b["kinetic"] == 0.0 and b["internal"] - a["internal"] == pytest.approx(a["kinetic"])
    engine.thicken(2.0)
    assert engine.steps.body.liquid.viscosity == 2.0 and engine.pressure(state) is None


@pytest.mark.parametrize("method", list(LiquidMethod))
def test_a_seen_surface_pulls_the_network_towards_it(method: LiquidMethod) -> None:
    """The liquid at rest, seen tilted: the twin's surface follows."""
    options = LiquidAssimilationOptions(method=method, first_height=5e-3, noise=5e-4)
    twin = GlassTwin(LiquidNodeEngine(network()), None, liquid(300), options)
    twin.begin()
    x = np.linspace(-0.9, 0.9, 20) * RADIUS
    places = np.stack([x, np.sqrt(RADIUS**2 - x**2)], axis=1)
    seen = SeenSurface(places, twin.surface(places) + 0.1 * x, np.ones(len(x), bool))
    before = np.abs(seen.height - twin.surface(places)).mean()
    assert twin.correct(seen).taken.all()
    assert np.abs(seen.height - twin.surface(places)).mean() < 0.5 * before
    assert twin.pressure() is None and twin.account()["work_assimilation"] > 0.0


def test_loaded_networks_run_twins_and_other_forms_are_refused(tmp_path) -> None:
    save_engine(network().model, tmp_path)
    engine = load_glass_engine(tmp_path)
    assert isinstance(engine, LiquidNodeEngine) and vars(engine)["folder"] == tmp_path
    body = replace(make_liquid(), frame_dt=FRAME)
    other, plain = engine, LiquidNodeEngine(network())
    states = []
    for one in (other, plain):
        one.prepare(body)
        none = np.zeros_like(body.points)
        states.append(one.step(one.start({"position": body.points, "velocity": none + 0.05}, none), none, none))
    np.testing.assert_allclose(states[0].velocity, states[1].velocity, atol=1e-5)  # compiled loops and torch
    with pytest.raises(DataError, match="no twin of a glass runs"):
        twin_engine_of(object(), tmp_path)
    with pytest.raises(OptionError, match="cannot be corrected"):
        GlassTwin(network(), None, body)
    choice = GlassChoice(400, 1.0, 1)
    with pytest.raises(OptionError, match="particle form"):
        choice.engine(engine)
    assert isinstance(choice.engine(ParticleEngine()), ParticleEngine)
