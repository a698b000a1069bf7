"""The sub-step form for liquids: its brackets, its account of energy, symmetry, walls, rest, and artifacts."""

from dataclasses import replace

import numpy as np
import pytest

from tests.tignn.liquid_bodies import make_liquid
from tests.tignn.particle_bodies import engine_for, equal_liquid, prism, random_profiles, stirred
from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.scene import Liquid
from zsdt.tignn.engine import load_engine
from zsdt.tignn.particle_engine import ParticleEngine, save_particle_engine
from zsdt.tignn.particle_kernel import kick, sense_walls, widen
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.tignn.particle_pairs import divergence, pair_forces, refresh_list
from zsdt.tignn.particle_profiles import start_profiles
from zsdt.tignn.particle_start import pressure_accelerations


def run(engine, fields, frames, load=None):
    load = np.zeros_like(fields["position"]) if load is None else load
    state = engine.start(fields, load)
    for _ in range(frames):
        state = engine.step(state, load, load)
    return state


def passes(engine, x, v, strain):
    """Both pair passes at one state; the velocities of the second are the widened ones."""
    c, w = engine.constants, engine.scratch
    refresh_list(c, x, w)
    sense_walls(c, engine.walls, engine.wall_table, x, w)
    pair_forces(c, engine.pair_table, x, v, strain, w)
    for i in range(len(x)):
        widen(w.wall[i], *v[i], w.wide[i])
    divergence(c, engine.pair_table, strain, w)
    return c, w


def total(account):
    return (
        account["kinetic"] + account["potential"] + account["internal"]
        - account["work_of_ports"] - account["integrator"]
    )  # fmt: skip


@pytest.mark.parametrize("shape", [None, prism()])
def test_pressure_and_divergence_are_exact_adjoints(shape):
    body = equal_liquid(shape)
    engine = engine_for(body, random_profiles(ParticleOptions()))
    draw = np.random.default_rng(1)
    v, strain = draw.normal(size=body.points.shape), draw.normal(size=body.nodes)
    c, w = passes(engine, body.points.copy(), v, strain)
    rate = w.rate.copy()
    push = np.empty_like(v)
    pressure_accelerations(c, engine.pair_table, c.stiffness * strain, w, push)
    given, stored = (c.mass * push * v).sum(), (c.volume * c.stiffness * strain * rate).sum()
    assert given == pytest.approx(stored, rel=1e-11)


def test_friction_and_pressure_keep_the_momentum_of_a_liquid_far_from_walls():
    body = equal_liquid()
    body.points = body.points + np.array([0.0, 0.0, 0.5])  # high above the rim, in the middle of the mouth
    body.points[:, :2] *= 0.1
    engine = engine_for(body, random_profiles(ParticleOptions()))
    fields = stirred(body)
    _, w = passes(engine, body.points.copy(), fields["velocity"], np.random.default_rng(2).normal(size=body.nodes))
    for part in (w.sums[:, :3], w.sums[:, 3:6]):
        assert np.abs(part.sum(0)).max() < 1e-11 * np.abs(part).sum()


def test_heat_of_friction_is_what_the_motion_loses_and_never_negative():
    body = equal_liquid()
    for seed in range(3):
        engine = engine_for(body, random_profiles(ParticleOptions(), seed, 1.0))
        c = engine.constants._replace(gravity=np.zeros(3), climb=0.0)
        v = np.random.default_rng(seed).normal(size=body.points.shape) * 0.3
        strain, heat, account = np.zeros(body.nodes), np.zeros(body.nodes), np.zeros(5)
        x, still = body.points.copy(), np.zeros_like(v)
        _, w = passes(engine, x, v, strain)
        dt = 0.3 * engine.critical_step()
        before = 0.5 * c.mass * (v**2).sum()
        kick(c, x, v, strain, heat, still, still, 0.5, dt, w, account)
        lost = before - 0.5 * c.mass * (v**2).sum()
        assert heat.sum() == pytest.approx(lost, rel=1e-11) and heat.min() >= 0.0


def test_energy_account_closes_to_rounding_while_the_liquid_sloshes():
    body = equal_liquid()
    engine = engine_for(body, random_profiles(ParticleOptions()))
    load = body.mass[:, None] * np.array([1.5, -0.5, 0.2])
    state = engine.start(stirred(body), load)
    first = engine.account(state)
    for _ in range(25):
        state = engine.step(state, load, load)
    last = engine.account(state)
    assert last["heat"] > 0.2 * first["kinetic"] and abs(last["work_load"]) > 1e-3 * first["kinetic"]
    assert total(last) == pytest.approx(total(first), abs=1e-10 * last["heat"])


def test_what_the_finite_sub_step_adds_falls_with_its_length():
    body = equal_liquid()
    missed = []
    for substeps in (16, 32):
        state = run(engine := engine_for(body, substeps=substeps), stirred(body), 5)
        missed.append(abs(engine.account(state)["integrator"]))
    assert missed[1] < 0.65 * missed[0]


@pytest.mark.parametrize("reflect", [False, True])
def test_it_commutes_with_turning_reflecting_and_renumbering(reflect):
    body = equal_liquid()
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    turn = turn @ np.diag([-1.0, 1.0, 1.0]) if reflect else turn
    order = np.random.default_rng(0).permutation(body.nodes)
    profiles = random_profiles(ParticleOptions())
    fields = stirred(body)
    ours = engine_for(body, profiles)
    plain = ours.read(run(ours, fields, 3))
    moved = {k: v[order] @ turn.T if v.shape[1] == 3 else v[order] for k, v in fields.items()}
    other = engine_for(replace(body, points=moved["position"], mass=body.mass[order]), profiles)
    turned = other.read(run(other, moved, 3))
    # The tables of the wall stand on a square grid, which a turn by an odd angle feels.
    assert np.abs(turned["position"] - plain["position"][order] @ turn.T).max() < 0.03 * body.pitch
    # A quarter turn maps the grid onto itself.
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([-1.0 if reflect else 1.0, 1, 1])
    moved = {k: v[order] @ quarter.T if v.shape[1] == 3 else v[order] for k, v in fields.items()}
    turned = other.read(run(other, moved, 3))
    assert np.abs(turned["position"] - plain["position"][order] @ quarter.T).max() < 1e-6 * body.pitch


def test_it_knows_no_unit_of_length():
    body = equal_liquid()
    fields = stirred(body)
    small = engine_for(body, random_profiles(ParticleOptions()))
    shape = replace(body.vessel, heights=[2 * h for h in body.vessel.heights], radii=[2 * r for r in body.vessel.radii])
    # Twice the size, the same gravity: times and speeds grow by sqrt 2, viscosity by 2 sqrt 2.
    root = np.sqrt(2.0)
    liquid = Liquid(viscosity=body.liquid.viscosity * 2 * root, sound_speed=body.liquid.sound_speed * root)
    large_body = replace(
        body, points=2 * body.points, mass=8 * body.mass, frame_dt=root * body.frame_dt, pitch=2 * body.pitch,
        vessel=shape, liquid=liquid,
    )  # fmt: skip
    speed = ParticleOptions().sound_speed
    large = engine_for(large_body, small.profiles, sound_speed=speed * root, climb=ParticleOptions().climb * root)
    assert large.steps == small.steps
    grown = {**fields, "position": 2 * fields["position"], "velocity": root * fields["velocity"]}
    one, two = small.read(run(small, fields, 3)), large.read(run(large, grown, 3))
    assert np.abs(two["position"] - 2 * one["position"]).max() < 1e-5 * body.pitch
    assert two["internal_energy"] == pytest.approx(2 * one["internal_energy"], rel=1e-4, abs=1e-8)


def test_a_thousand_frames_come_to_rest_and_stay_there():
    body = equal_liquid()
    engine = engine_for(body)
    state = run(engine, stirred(body, 0.05), 400)
    settled = state.position.copy()
    zero = np.zeros_like(settled)
    for _ in range(600):
        state = engine.step(state, zero, zero)
    assert np.sqrt((state.velocity**2).sum(1).mean()) < 5e-4  # the packing creeps, ever slower
    assert np.sqrt(((state.position - settled) ** 2).sum(1).mean()) < 0.3 * body.pitch
    assert engine.account(state)["guarded"] == 0


@pytest.mark.parametrize("shape", [None, prism()])
def test_no_particle_crosses_a_wall_even_when_thrown_at_it(shape):
    from zsdt.fluid.vessel import Vessel

    body = equal_liquid(shape)
    engine = engine_for(body, substeps=30)
    fields = stirred(body)
    fields["velocity"] = np.tile([1.5, 0.4, -1.5], (body.nodes, 1))
    zero = np.zeros_like(fields["position"])
    state = engine.start(fields, zero)
    for _ in range(20):
        state = engine.step(state, zero, zero)
        assert Vessel(body.vessel).distance(state.position).min() > 0.05 * body.pitch


def test_the_same_rollout_twice_is_the_same_to_the_last_bit():
    body = equal_liquid()
    engine = engine_for(body)
    one, two = run(engine, stirred(body), 4), run(engine, stirred(body), 4)
    assert np.array_equal(one.position, two.position) and np.array_equal(one.heat, two.heat)


def test_a_saved_engine_rolls_out_the_same(tmp_path):
    body = equal_liquid()
    engine = engine_for(body, random_profiles(ParticleOptions()))
    save_particle_engine(tmp_path, engine)
    again = load_engine(tmp_path)
    again.single = engine.single
    again.prepare(body)
    assert np.array_equal(run(engine, stirred(body), 2).position, run(again, stirred(body), 2).position)
    (tmp_path / "engine.json").write_text('{"kind": "particle"}')
    with pytest.raises(DataError, match="train it again"):
        load_engine(tmp_path)


def test_wrong_bodies_and_wild_starts_are_refused():
    body = equal_liquid()
    with pytest.raises(OptionError, match="liquid"):
        ParticleEngine().prepare(replace(body, liquid=None))
    with pytest.raises(OptionError, match="one mass"):
        ParticleEngine().prepare(make_liquid())
    engine = engine_for(body)
    fields = stirred(body)
    fields["position"][3] = np.nan
    with pytest.raises(RunRejected):
        engine.start(fields, np.zeros_like(fields["position"]))
    with pytest.raises(OptionError, match="degree"):
        ParticleOptions(degree=4)
    assert start_profiles(3.0, 2).coefficients.shape[1] == 3
