"""What a step of a liquid keeps whatever the weights are: energy, entropy, momentum, symmetry, numbering."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.tignn.liquid_bodies import PITCH, make_flow, make_liquid
from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.tignn.liquid_body import LiquidBody, wall_nodes
from zsdt.tignn.liquid_engine import LiquidEngine, probe_liquid
from zsdt.tignn.liquid_exchange import Springs, exchange_potentials
from zsdt.tignn.liquid_features import LiquidScales, LiquidState, filled_by_wall, look, merge_liquids, wall_share
from zsdt.tignn.liquid_model import LiquidModel, advance
from zsdt.tignn.options import Bracket, Energy, LiquidOptions, TignnOptions, Walls

torch.set_num_threads(1)
SMALL = {"width": 12, "passes": 2, "rank": 2}
SCALES = LiquidScales(velocity=0.05, energy=0.02, d_velocity=0.004, d_energy=5e-4, frame_dt=0.004, viscosity=1e-3)
FORMS = {
    "exact": TignnOptions(**SMALL),
    "physical": TignnOptions(**SMALL, energy=Energy.physical),
    "soft": TignnOptions(**SMALL, bracket=Bracket.soft),
    "none": TignnOptions(**SMALL, bracket=Bracket.none),
}
WALL_FORMS = {
    f"{name}, walls as {w.value}": replace(o, liquid=LiquidOptions(walls=w)) for name, o in FORMS.items() for w in Walls
}


def double_model(options: TignnOptions, seed: int = 0) -> LiquidModel:
    torch.manual_seed(seed)
    return LiquidModel(options, SCALES).double()


def random_state(body, seed: int = 0) -> LiquidState:
    draw = np.random.default_rng(seed)
    n = body.nodes
    return LiquidState(body.points.copy(), 0.1 * draw.normal(size=(n, 3)), 0.02 * draw.random((n, 1)))


def random_load(body, seed: int = 3):
    return 2.0 * body.mass[:, None] * np.random.default_rng(seed).normal(size=(body.nodes, 3))


@pytest.mark.parametrize("name", [n for n in WALL_FORMS if n.startswith(("exact", "physical"))])
def test_exact_brackets_are_degenerate_to_rounding(name: str) -> None:
    body = make_liquid()
    model = double_model(WALL_FORMS[name])
    found = probe_liquid(model, LiquidBody(body, model.options), random_state(body), random_load(body))
    assert found["energy_residual"] < 1e-12 and found["energy_leak"] < 1e-12
    assert found["entropy_leak"] < 1e-12
    assert found["entropy_production"] > 0.0


def test_soft_brackets_leak() -> None:
    body = make_liquid()
    model = double_model(FORMS["soft"])
    found = probe_liquid(model, LiquidBody(body, model.options), random_state(body), random_load(body))
    assert found["energy_leak"] > 1e-3 and found["entropy_leak"] > 1e-3 and found["bulk_ldS"] > 1e-3


def test_particles_exchange_momentum_and_no_more() -> None:
    """Away from walls the momentum of the liquid changes by weight and load alone, under any weights."""
    body, options = make_liquid(), FORMS["physical"]
    model, state = double_model(options), random_state(body)
    middle = body.points - [0.0, 0.0, body.points[:, 2].mean() - 0.04]
    keep = np.linalg.norm(middle - [0, 0, 0.04], axis=1) < 0.01  # a drop that no wall is near
    drop = replace(body, points=middle[keep], mass=body.mass[keep], clamped=body.clamped[keep])
    prepared = LiquidBody(drop, options)
    state = LiquidState(drop.points, state.velocity[keep], state.energy[keep])
    load = random_load(drop)
    moved = advance(model, prepared, state, load)
    gained = (drop.mass[:, None] * (moved.state.velocity - state.velocity)).sum(0)
    given = drop.frame_dt * (load.sum(0) + drop.mass.sum() * drop.gravity)
    alone = np.abs(drop.mass[:, None] * (moved.state.velocity - state.velocity)).sum()
    assert np.abs(gained - given).max() < 1e-12 * alone
    exchanged = moved.state.velocity - state.velocity - drop.frame_dt * (drop.gravity + load / drop.mass[:, None])
    assert np.abs(exchanged).max() > 1e-6


@pytest.mark.parametrize("walls", list(Walls))
def test_physical_energy_closes_the_budget_of_finite_steps(walls: Walls) -> None:
    """Joules in motion, height and heat change by the work of load and clamp, to rounding, for random weights."""
    body = make_liquid()
    options = replace(FORMS["physical"], liquid=LiquidOptions(walls=walls, relaxation=2))
    engine = LiquidEngine(double_model(options), dtype=torch.float64)
    engine.prepare(body)
    state = random_state(body)
    fields = {"position": state.position, "velocity": state.velocity, "internal_energy": state.energy}
    load = random_load(body)
    run = engine.start(fields, load)
    names = ("kinetic", "potential", "internal")
    for _ in range(4):
        before, run = run.account, engine.step(run, load, 2.0 * load)
        change = sum(run.account[n] - before[n] for n in names)
        work = run.account["work_of_ports"] - before["work_of_ports"]
        assert abs(change - work) < 1e-11 * sum(abs(run.account[n]) for n in names)
    assert engine.put_back > 0


@pytest.mark.parametrize("name", list(FORMS))
def test_predictions_turn_and_mirror_with_the_liquid(name: str) -> None:
    body, model = make_liquid(), double_model(FORMS[name])
    state, load = random_state(body), random_load(body)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    for change in (turn, turn @ np.diag([1.0, -1.0, 1.0])):
        turned = LiquidState(state.position @ change.T, state.velocity @ change.T, state.energy)
        plain = advance(model, LiquidBody(body, model.options), state, load).state
        other = advance(model, LiquidBody(body, model.options), turned, load @ change.T).state
        # The iterative exchange stops at a tolerance, and its preconditioner knows the axes.
        close = 2e-3 if name == "physical" else 1e-9
        size = np.abs(plain.velocity - state.velocity).max()
        assert np.abs(other.velocity - plain.velocity @ change.T).max() < close * size
        assert np.abs(other.energy - plain.energy).max() < close * np.abs(plain.energy - state.energy).max()


@pytest.mark.parametrize("name", list(FORMS))
def test_numbering_does_not_matter(name: str) -> None:
    body, model = make_liquid(), double_model(FORMS[name])
    state, load = random_state(body), random_load(body)
    order = np.random.default_rng(5).permutation(body.nodes)
    shuffled = replace(body, points=body.points[order], mass=body.mass[order])
    other = LiquidState(state.position[order], state.velocity[order], state.energy[order])
    first = advance(model, LiquidBody(body, model.options), state, load).state
    second = advance(model, LiquidBody(shuffled, model.options), other, load[order]).state
    size = np.abs(first.velocity - state.velocity).max()
    assert np.abs(second.velocity - first.velocity[order]).max() < 1e-8 * size


@pytest.mark.parametrize("name", list(FORMS))
def test_a_graph_does_not_depend_on_its_batch(name: str) -> None:
    model = double_model(FORMS[name])
    bodies = [make_liquid(seed=k, depth=d) for k, d in enumerate((0.03, 0.02))]
    looks = [
        look(LiquidBody(b, model.options), random_state(b), random_load(b), SCALES, True, torch.float64) for b in bodies
    ]
    with torch.no_grad():
        alone = torch.cat([model(x).total for x in looks])
        together = model(merge_liquids(looks)).total
    assert torch.allclose(alone, together, rtol=1e-9, atol=1e-9 * float(alone.abs().max()))


def test_the_exchange_gives_what_is_wanted_where_momentum_allows() -> None:
    """A chain of particles that stands on the floor can carry its weight; a free one cannot."""
    n = 12
    pairs = np.array([[i, i + 1] for i in range(n - 1)])
    arms = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).repeat(n - 1, 1)
    wanted = torch.zeros(n, 3, dtype=torch.float64)
    wanted[:, 2] = 1.0
    wanted.requires_grad_(True)
    one, free = torch.ones(n - 1, 1, dtype=torch.float64), torch.ones(n, 1, dtype=torch.float64)
    for floor in (1.0, 0.0):
        walls = torch.zeros(n, 3, dtype=torch.float64)
        walls[0, 2] = floor
        springs = Springs(pairs, arms, one, walls, free, np.zeros(n, np.int64))
        y = exchange_potentials(wanted, springs)
        pushed = (arms * (y[:-1] - y[1:])).sum(1, keepdim=True) * arms
        given = torch.zeros_like(wanted).index_add(0, torch.from_numpy(pairs[:, 0]), pushed)
        given = given.index_add(0, torch.from_numpy(pairs[:, 1]), -pushed) + (walls * y).sum(1, keepdim=True) * walls
        if floor:
            assert torch.allclose(given, wanted, atol=0.02)
        else:
            assert float(given.abs().max()) < 1e-6
    walls[0, 2] = 1.0
    springs = Springs(pairs, arms, one, walls, free, np.zeros(n, np.int64))
    draw = torch.Generator().manual_seed(0)
    start = (torch.randn(n, 3, dtype=torch.float64, generator=draw) * torch.tensor([0.0, 0.0, 1.0])).requires_grad_(
        True
    )
    weights = torch.randn(n, 3, dtype=torch.float64, generator=draw) * torch.tensor([0.0, 0.0, 1.0])
    (exchange_potentials(start, springs) * weights).sum().backward()
    step = torch.zeros_like(start)
    step[3, 2] = 1e-3
    with torch.no_grad():
        moved = [float((exchange_potentials(start + s * step, springs) * weights).sum()) for s in (1, -1)]
    assert start.grad is not None
    assert float(start.grad[3, 2]) == pytest.approx((moved[0] - moved[1]) / 2e-3, rel=1e-2)


def test_nobody_leaves_the_vessel_or_sinks_into_its_wall() -> None:
    body = make_liquid()
    prepared = LiquidBody(body, FORMS["exact"])
    thrown = body.points + np.random.default_rng(0).normal(size=body.points.shape) * 0.01
    speed = np.random.default_rng(1).normal(size=body.points.shape)
    position, velocity, count = prepared.keep_inside(thrown, speed)
    distance, normal = prepared.vessel.distance_and_normal(position)
    assert distance.min() > 0.09 * PITCH and count > 10
    out = prepared.vessel.distance(thrown) < prepared.clearance
    assert ((velocity[out] * prepared.vessel.distance_and_normal(thrown[out])[1]).sum(1) > -1e-12).all()
    assert np.array_equal(velocity[~out], speed[~out]) and normal.shape == position.shape


def test_a_motion_that_blows_up_is_rejected() -> None:
    body, model = make_liquid(), double_model(FORMS["none"])
    state = random_state(body)
    for cause, velocity in (("supersonic", 1e3 * state.velocity), ("not_finite", np.nan * state.velocity)):
        position = state.position + velocity if cause == "not_finite" else state.position
        with pytest.raises(RunRejected) as error:
            advance(model, LiquidBody(body, model.options), LiquidState(position, velocity, state.energy), body.points)
        assert error.value.cause == cause


def test_relaxation_parts_particles_and_leaves_their_centre() -> None:
    body = make_liquid()
    prepared = LiquidBody(body, replace(FORMS["exact"], liquid=LiquidOptions(relaxation=20)))
    close = np.array([[0.0, 0.0, 0.02], [0.2 * PITCH, 0.0, 0.02], [0.0, 0.0, 0.05]])
    parted = prepared.relax(close)
    assert np.linalg.norm(parted[0] - parted[1]) > 0.7 * PITCH
    assert np.allclose(parted[:2].mean(0), close[:2].mean(0)) and np.array_equal(parted[2], close[2])


def test_what_a_flat_wall_takes_away_is_an_integral_over_a_cap() -> None:
    cutoff, step = 1.8, 0.02
    grid = np.arange(-cutoff, cutoff, step) + step / 2
    x, y, z = np.meshgrid(grid, grid, grid, indexing="ij")
    r = np.sqrt(x**2 + y**2 + z**2)
    weight = np.clip(1 - r / cutoff, 0, None) * step**3
    assert (wall_share(np.linspace(1.7, 1.9, 200), cutoff) >= 0.0).all()
    for d in (0.0, 0.5, 1.2):
        beyond = z > d
        pressed, taken = (weight * z / r)[beyond].sum(), weight[beyond].sum() / weight.sum()
        assert float(wall_share(np.array([d]), cutoff)[0]) == pytest.approx(pressed, rel=0.01)
        assert float(filled_by_wall(np.array([d]), cutoff)[0]) == pytest.approx(taken, rel=0.03)


def test_wall_nodes_lie_on_the_wall_a_spacing_apart() -> None:
    prepared = LiquidBody(make_liquid(), replace(FORMS["exact"], liquid=LiquidOptions(walls=Walls.nodes)))
    points = wall_nodes(prepared.vessel, PITCH, 0.03)
    assert np.abs(prepared.vessel.distance(points)).max() < 1e-3 * PITCH
    gaps = np.linalg.norm(points[:, None] - points[None], axis=-1) + np.eye(len(points))
    assert gaps.min() > 0.85 * PITCH and len(points) > 50
    links = prepared.connect(prepared.body.points)
    assert len(links.nodes) > prepared.fluids
    assert not (links.pairs >= prepared.fluids).all(1).any()  # no edge between two points of the wall


def test_a_list_with_skin_gives_the_same_graph() -> None:
    body = make_liquid()
    lazy, fresh = (LiquidBody(body, replace(FORMS["exact"], liquid=LiquidOptions(skin=s))) for s in (0.5, 0.0))
    draw = np.random.default_rng(0)
    x = body.points.copy()
    for _ in range(4):
        one, two = lazy.connect(x), fresh.connect(x)
        assert np.array_equal(one.neighbour, two.neighbour) and np.array_equal(one.halves, two.halves)
        assert np.array_equal(one.neighbour[one.halves[:, 0]], one.pairs[:, 1])
        assert np.array_equal(one.neighbour[one.halves[:, 1]], one.pairs[:, 0])
        x = x + 0.03 * PITCH * draw.normal(size=x.shape)
    assert lazy.search.builds < fresh.search.builds


def test_solids_and_senseless_choices_are_refused() -> None:
    with pytest.raises(DataError, match="vessel"):
        LiquidBody(replace(make_liquid(), vessel=None), TignnOptions())
    with pytest.raises(OptionError, match="exact"):
        TignnOptions(energy=Energy.physical, bracket=Bracket.soft)
    with pytest.raises(OptionError, match="cutoff"):
        LiquidOptions(cutoff=0.5)
    assert make_flow(make_liquid()).frames == 8
