"""The two laws hold by construction for the exact bracket, and do not for the soft one."""

import numpy as np
import pytest
import torch

from tests.tignn.conftest import batch_in_double, loads_of, make_body, random_state, unit_model
from zsdt.errors import OptionError
from zsdt.tignn.bracket_kernels import sum_brackets
from zsdt.tignn.features import NodeState, Scales
from zsdt.tignn.model import NodeModel
from zsdt.tignn.node_engine import learned_budget, probe
from zsdt.tignn.options import Bracket, Energy, TignnOptions

SMALL = {"width": 16, "passes": 2, "local_passes": 1}
EXACT = {
    "staggered": TignnOptions(**SMALL),
    "one bracket": TignnOptions(**SMALL, staggered=False, stress_memory=1.0, stress_input=True, rank=3),
    "physical": TignnOptions(**SMALL, staggered=False, stress_memory=1.0, energy=Energy.physical),
}


def random_brackets(seed: int, nodes: int = 6, rank: int = 2, d: int = 4):
    draw = np.random.default_rng(seed)
    pairs = np.array([(i, j) for i in range(nodes) for j in range(i + 1, nodes) if draw.random() < 0.6])
    halves = draw.permutation(2 * len(pairs)).reshape(-1, 2)
    torch.manual_seed(seed)
    vectors = torch.randn(2 * len(pairs), 3, rank, d, dtype=torch.float64)
    energy, entropy = torch.randn(2, nodes, d, dtype=torch.float64)
    return pairs, halves, vectors, energy, entropy


def dense_operators(pairs, halves, vectors, energy, entropy) -> tuple[np.ndarray, np.ndarray]:
    """L and M of the whole graph, assembled from the formulas of DESIGN 4.1."""
    nodes, d = energy.shape
    poisson, friction = np.zeros((2, nodes * d, nodes * d))
    for row, (i, j) in enumerate(pairs):
        place = np.r_[i * d : (i + 1) * d, j * d : (j + 1) * d]
        e, s = (np.concatenate([g[i], g[j]]) for g in (energy.numpy(), entropy.numpy()))
        for k in range(vectors.shape[2]):
            a, b, c = (np.concatenate([vectors[h, kind, k] for h in halves[row]]) for kind in range(3))
            a, b = (x - s * (s @ x) / (s @ s) for x in (a, b))
            c = c - e * (e @ c) / (e @ e)
            poisson[np.ix_(place, place)] += np.outer(a, b) - np.outer(b, a)
            friction[np.ix_(place, place)] += np.outer(c, c)
    return poisson, friction


@pytest.mark.parametrize("seed", range(3))
def test_kernel_is_the_assembled_operator(seed: int) -> None:
    pairs, halves, vectors, energy, entropy = random_brackets(seed)
    poisson, friction = dense_operators(pairs, halves, vectors, energy, entropy)
    e, s = energy.numpy().ravel(), entropy.numpy().ravel()
    assert np.abs(poisson @ s).max() < 1e-12 * np.abs(poisson).max() * np.abs(s).max() * len(s)
    assert np.abs(friction @ e).max() < 1e-12 * np.abs(friction).max() * np.abs(e).max() * len(e)
    assert np.linalg.eigvalsh(friction).min() > -1e-12 * np.abs(friction).max()
    reversible, irreversible = sum_brackets(pairs, halves, vectors, energy, entropy)
    assert np.allclose(reversible.numpy().ravel(), poisson @ e, atol=1e-11)
    assert np.allclose(irreversible.numpy().ravel(), friction @ s, atol=1e-11)


@pytest.mark.parametrize("size", [1, 2])
def test_gradient_agrees_with_finite_differences(size: int) -> None:
    pairs, halves, vectors, energy, entropy = random_brackets(7, nodes=4, d=3)
    if size == 1:
        pairs = halves = np.arange(len(energy))[:, None]
        vectors = vectors[: len(energy)]
    inputs = [t.clone().requires_grad_() for t in (vectors, energy, entropy)]
    assert torch.autograd.gradcheck(lambda *a: sum_brackets(pairs, halves, *a), inputs)


def test_the_two_nodes_of_an_edge_have_no_order() -> None:
    pairs, halves, vectors, energy, entropy = random_brackets(3)
    there = sum_brackets(pairs, halves, vectors, energy, entropy)
    back = sum_brackets(pairs[:, ::-1].copy(), halves[:, ::-1].copy(), vectors, energy, entropy)
    for x, y in zip(there, back, strict=True):
        assert torch.allclose(x, y, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("seed", range(3))
def test_exact_bracket_is_degenerate_for_random_weights_and_graphs(name: str, seed: int) -> None:
    options = EXACT[name]
    body = make_body((3 + seed, 2, 2), seed=seed)
    model, batch = unit_model(options, seed), batch_in_double(body)
    found = probe(model, batch, random_state(body, options, seed), *loads_of(body, seed))
    assert found["energy_residual"] < 1e-12
    assert found["entropy_leak"] < 1e-12
    assert found["energy_leak"] < 1e-12
    assert found["entropy_production"] >= 0.0


@pytest.mark.parametrize("name", EXACT)
def test_energy_changes_by_the_work_of_the_ports_alone(name: str) -> None:
    options = EXACT[name]
    body = make_body()
    model, batch, state = unit_model(options), batch_in_double(body), random_state(body, options)
    load, load_next = loads_of(body)
    with torch.inference_mode():
        for rates in model(batch, state, load, load_next).rates:
            change, work, produced = learned_budget(rates)
            size = float((rates.energy * rates.total).abs().sum())
            assert abs(change - work) < 1e-12 * size
            assert abs(work) > 1e-6 * size
            assert produced > 0.0
        body.gravity[:] = 0.0
        still = model(batch_in_double(body), state, 0.0 * load, 0.0 * load)
    assert all(float(r.port.abs().max()) == 0.0 for r in still.rates)


def test_soft_bracket_has_structure_but_leaks() -> None:
    options = TignnOptions(**SMALL, bracket=Bracket.soft)
    body = make_body()
    model, batch, state = unit_model(options), batch_in_double(body), random_state(body, options)
    found = probe(model, batch, state, *loads_of(body))
    assert found["energy_residual"] > 1e-3
    assert found["bulk_ldS"] > 1e-3 and found["bulk_mdE"] > 1e-3
    bracket = model.first.bracket
    poisson, friction = bracket._matrices(torch.randn(5, bracket.lower.shape[1] + bracket.full.shape[1]).double())
    assert torch.equal(poisson, -poisson.transpose(1, 2))
    assert float(torch.linalg.eigvalsh(friction).min()) > -1e-12


def test_the_soft_penalty_is_that_of_the_seed() -> None:
    options = TignnOptions(**SMALL, bracket=Bracket.soft, staggered=False)
    body = make_body()
    with torch.inference_mode():
        step = unit_model(options)(batch_in_double(body), random_state(body, options), *loads_of(body))
    rates = step.rates[0]
    assert rates.mdE is not None and rates.ldS is not None and step.penalty is not None
    assert float(step.penalty) == pytest.approx(float(rates.mdE.square().mean() + rates.ldS.square().mean()))


def test_physical_energy_closes_at_a_finite_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kinetic + elastic + dissipated change by the work of load and weight to rounding, step after step."""
    from zsdt.tignn.node_engine import NodeEngine, NodeRun

    options = EXACT["physical"]
    body = make_body()
    engine = NodeEngine(unit_model(options), dtype=torch.float64)
    monkeypatch.setattr(
        engine, "_check", lambda state: None
    )  # random weights throw nodes far; the account closes there too
    engine.prepare(body)
    state: NodeState = random_state(body, options)
    load, load_next = (x.numpy() for x in loads_of(body))
    run = NodeRun(state, engine._energies(state, {}, None))
    for _ in range(3):
        before = run.account
        run = engine.step(run, load, load_next)
        names = ("kinetic", "elastic", "dissipated")
        change = sum(run.account[n] - before[n] for n in names)
        work = run.account["work_of_ports"] - before["work_of_ports"]
        size = sum(abs(run.account[n]) for n in names)
        assert abs(change - work) < 1e-12 * size


def test_combinations_that_mean_nothing_are_refused() -> None:
    with pytest.raises(OptionError, match="staggered"):
        NodeModel(TignnOptions(energy=Energy.physical), Scales())
    with pytest.raises(OptionError, match="exact"):
        TignnOptions(energy=Energy.physical, bracket=Bracket.none)
