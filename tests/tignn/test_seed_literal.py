"""The seed's network to the letter: its size, its operators, and what an engine of it must keep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from tests.tignn.conftest import make_body, make_trajectory
from tests.tignn.liquid_bodies import make_flow, make_liquid
from zsdt.errors import OptionError, RunRejected
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.tignn.options import Bracket, TrainingOptions
from zsdt.tignn.seed_engine import SeedEngine, SeedModel, SeedScales, literal_options, save_engine
from zsdt.tignn.seed_literal import SeedNetwork, SeedSizes
from zsdt.tignn.seed_train import SeedStream, SeedTraining, clip_of, scales_of


def small(**changes):
    return literal_options(width=12, passes=2, **changes)


def solid_model(seed: int = 0) -> tuple[SeedModel, object]:
    torch.manual_seed(seed)
    trajectory = make_trajectory(make_body())
    return SeedModel(small(), scales_of([trajectory])), trajectory


def liquid_model(seed: int = 0) -> tuple[SeedModel, object]:
    torch.manual_seed(seed)
    flow = make_flow(make_liquid(radius=0.016, depth=0.02))
    return SeedModel(small(), scales_of([flow])), flow


def test_the_liquid_of_the_seed_has_its_299_thousand_parameters() -> None:
    def count(**changes) -> int:
        return sum(p.numel() for p in SeedNetwork(SeedSizes(7), **changes).parameters())

    per_pass = (300 * 100 + 100 + 2 * 10_100) + (200 * 100 + 100 + 2 * 10_100)
    assert count() == 299_663
    assert count(shared=False) == 299_663 + 6 * per_pass


@pytest.mark.parametrize("sizes", [SeedSizes(12, 3), SeedSizes(7)])
def test_operators_are_skew_and_positive_semi_definite(sizes: SeedSizes) -> None:
    torch.manual_seed(3)
    network = SeedNetwork(sizes, width=10).double()
    skew, damping = network.operators(3.0 * torch.randn(40, 30, dtype=torch.float64))
    assert skew.abs().max() > 0.05
    assert torch.equal(skew, -skew.transpose(1, 2))
    assert torch.equal(damping, damping.transpose(1, 2))
    smallest = torch.linalg.eigvalsh(damping).min(dim=1).values
    assert smallest.min() > -1e-12 * damping.abs().max()


def test_bulk_produces_entropy_and_the_penalty_is_what_its_matrices_leave() -> None:
    """dS/dt of an isolated node is dS.M dS >= 0 up to dS.L dE, and the penalty vanishes with L dS and M dE."""
    torch.manual_seed(1)
    network = SeedNetwork(SeedSizes(7), width=10).double()
    nobody = torch.zeros(0, dtype=torch.int64)
    node, edge = torch.randn(9, 5, dtype=torch.float64), torch.zeros(0, 4, dtype=torch.float64)
    rates = network(node, edge, None, nobody, nobody)
    assert ((rates.entropy * rates.irreversible).sum(1) >= 0).all()
    assert (rates.energy * rates.reversible).sum(1).abs().max() < 1e-12  # skew: L dE is across dE
    expected = rates.ldS.square().mean() + rates.mdE.square().mean()
    assert rates.penalty > 0 and torch.isclose(rates.penalty, expected)
    for decoder in (network.poisson, network.friction):
        nn.init.zeros_(decoder.last.weight), nn.init.zeros_(decoder.last.bias)
    assert network(node, edge, None, nobody, nobody).penalty == 0


def test_rates_are_those_of_the_seeds_third_equation_written_out() -> None:
    """z_i' = L_i dE_i + M_i dS_i - sum_j (L_ij dE_j + M_ij dS_j), edge by edge."""
    torch.manual_seed(2)
    network = SeedNetwork(SeedSizes(7), width=10, passes=2).double()
    to, source = torch.tensor([0, 0, 1, 2]), torch.tensor([1, 2, 0, 0])
    node, edge = torch.randn(3, 5, dtype=torch.float64), torch.randn(4, 4, dtype=torch.float64)
    x, e = network.latents(node, edge, None, to, source)
    energy, entropy = network.energy(x), network.entropy(x)
    expected = torch.zeros(3, 7, dtype=torch.float64)
    for i in range(3):
        skew, damping = network.operators(torch.cat([torch.ones_like(x[i]), x[i], x[i]])[None])
        expected[i] += skew[0] @ energy[i] + damping[0] @ entropy[i]
    for k in range(4):
        i, j = int(to[k]), int(source[k])
        skew, damping = network.operators(torch.cat([e[k], x[j], x[i]])[None])
        expected[i] -= skew[0] @ energy[j] + damping[0] @ entropy[j]
    assert torch.allclose(network(node, edge, None, to, source).total, expected, atol=1e-12)


def test_renumbering_nodes_renumbers_the_rates() -> None:
    torch.manual_seed(0)
    network = SeedNetwork(SeedSizes(12, 3), width=10).double()
    body = make_body()
    to = torch.from_numpy(np.concatenate([body.pairs[:, 0], body.pairs[:, 1]]))
    source = torch.from_numpy(np.concatenate([body.pairs[:, 1], body.pairs[:, 0]]))
    draw = torch.Generator().manual_seed(0)
    node, edge, force = (
        torch.randn(rows, columns, generator=draw, dtype=torch.float64)
        for rows, columns in ((body.nodes, 10), (len(to), 4), (body.nodes, 3))
    )
    place = torch.randperm(body.nodes, generator=draw)
    back = torch.argsort(place)
    straight = network(node, edge, force, to, source).total
    turned = network(node[place], edge, force[place], back[to], back[source]).total
    assert torch.allclose(turned, straight[place], atol=1e-12)


def test_engine_holds_the_clamp_steps_explicitly_and_comes_back_from_its_folder(tmp_path: Path) -> None:
    model, trajectory = solid_model()
    engine = SeedEngine(model)
    rollout = roll_out(engine, trajectory)
    held = trajectory.body.clamped
    assert np.allclose(rollout.fields["position"][:, held], trajectory.fields["position"][0, held], atol=1e-6)
    state = engine.start(trajectory.at(0), trajectory.load[0])
    with torch.inference_mode():
        rates = model(state, model.scaled_force(trajectory.load[1]), engine._body.graph(trajectory.body.points)[0])
    after = engine.step(state, trajectory.load[0], trajectory.load[1])
    free = torch.from_numpy(~held)
    assert torch.allclose((after - state)[free], trajectory.body.frame_dt * rates.total[free], atol=1e-6)
    save_engine(model, tmp_path)
    again = roll_out(load_engine(tmp_path), trajectory)
    assert np.array_equal(again.fields["stress"], rollout.fields["stress"])


def test_liquid_sees_its_vessel_as_nodes_and_a_blow_up_is_said() -> None:
    model, flow = liquid_model()
    engine = SeedEngine(model)
    engine.prepare(flow.body)
    graph, walls = engine._body.graph(flow.fields["position"][0])
    assert len(walls) > 0
    assert graph.kind[: flow.body.nodes].all() and not graph.kind[flow.body.nodes :].any()
    rollout = roll_out(engine, flow, 3)
    assert rollout.fields["internal_energy"].shape == (3, flow.body.nodes, 1)
    with torch.no_grad():
        model.network.energy.last.bias.fill_(float("inf"))
    with pytest.raises(RunRejected, match="not a number"):
        engine.step(engine.start(flow.at(0), flow.load[0]), flow.load[0], flow.load[1])


def test_training_learns_and_judges_free_nodes_only() -> None:
    """The rate that leads to the next state is learned: the loss of one sample falls by half in 60 steps."""
    model, trajectory = solid_model()
    training = TrainingOptions(steps=60, batch=1, noise=0.0)
    stream = SeedStream([clip_of(trajectory, model)], model, training)
    sample = stream.sample(0)
    assert torch.equal(sample.judged[:, 0] > 0, torch.from_numpy(~trajectory.body.clamped))
    whole = SeedTraining(model, training)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = whole.training_step(sample, 0)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.5 * losses[0]


def test_another_bracket_is_refused() -> None:
    with pytest.raises(OptionError, match="soft"):
        SeedModel(literal_options(bracket=Bracket.exact), SeedScales([0.0] * 7, [1.0] * 7, [], []))
