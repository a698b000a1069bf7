"""Psi_ini: what it must not depend on, and that it learns stress at rest on a size it has not seen."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.tignn.cell_bodies import body_of
from zsdt.errors import DataError, OptionError
from zsdt.tignn.cell_energy import CellOptions, card_of, nominal_constants
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.psi_ini import PsiIni, PsiIniNetwork, PsiIniOptions, inputs_of, load, merge_inputs, train
from zsdt.trajectory import DatasetEntry, Trajectory, write_index, write_trajectory


def deformed(body, seed=0):
    return body.points + 0.003 * np.random.default_rng(seed).standard_normal(body.points.shape)


def random_network(seed=0):
    torch.manual_seed(seed)
    return PsiIni(PsiIniNetwork(PsiIniOptions(width=16, passes=2)), PsiIniOptions(width=16, passes=2))


def test_a_turned_body_has_the_turned_stress():
    body, psi_ini = body_of((4, 2, 2)), random_network()
    position = deformed(body)
    turn, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    i, j = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    before = psi_ini.infer(body, position)
    tensor = np.empty((body.nodes, 3, 3))
    tensor[:, i, j] = tensor[:, j, i] = before
    # The material, and with it the grid that it carries, stays; what is seen is turned.
    after = psi_ini.infer(replace(body, gravity=turn @ body.gravity), position @ turn.T + 1.0)
    np.testing.assert_allclose(after, (turn @ tensor @ turn.T)[:, i, j], atol=2e-4 * np.abs(before).max())


def test_a_stiffer_body_under_more_gravity_has_more_stress_in_proportion():
    body, psi_ini = body_of((4, 2, 2)), random_network()
    position = deformed(body)
    double = replace(body, gravity=2 * body.gravity, material=replace(body.material, young=2 * body.material.young))
    np.testing.assert_allclose(psi_ini.infer(double, position), 2 * psi_ini.infer(body, position), rtol=1e-4, atol=1e-3)


def test_result_does_not_depend_on_the_rest_of_the_batch():
    network = random_network().network
    parts = [inputs_of(b, deformed(b, k)) for k, b in enumerate((body_of((4, 2, 2)), body_of((3, 3, 2))))]
    with torch.no_grad():
        together = network(merge_inputs(parts))
        alone = torch.cat([network(p) for p in parts])
    assert torch.allclose(together, alone, atol=1e-6)


def test_a_body_without_material_is_refused():
    body = replace(body_of(), material=None)
    with pytest.raises(OptionError, match="material"):
        random_network().infer(body, body.points)


@pytest.fixture(scope="module")
def small_dataset(tmp_path_factory):
    """Beams at rest whose stress comes from the cell energy of their material."""
    folder, entries = tmp_path_factory.mktemp("rest"), []
    cases = [("train", (4, 2, 2)), ("train", (5, 3, 2)), ("train", (6, 2, 3)), ("val", (5, 2, 2)), ("test", (5, 2, 3))]
    for k, (split, counts) in enumerate(cases):
        body = body_of(counts)
        engine = CellEngine(nominal_constants(*card_of(body)), CellOptions())
        engine.prepare(body)
        zero = np.zeros_like(body.points)
        state = engine.start({"position": body.points, "velocity": zero}, zero)
        state.offset[:] = 0.0
        fields = {name: value[None] for name, value in engine.read(state).items()}
        name = f"rest_{k}"
        trajectory = Trajectory(body, np.zeros(1), fields, zero[None], meta={"name": name})
        write_trajectory(folder / f"{name}.h5", trajectory)
        entries.append(DatasetEntry(f"{name}.h5", name, split, "hand", "rest"))
    write_index(folder, entries)
    return folder


def test_it_learns_the_stress_of_a_size_it_has_not_seen(small_dataset, tmp_path):
    options = PsiIniOptions(width=24, passes=2, steps=240, extra=0, check_every=80, batch=3)
    result = train(small_dataset, options, tmp_path / "out", tmp_path / "scratch")
    assert result["test"]["axial_rrmse"] < 0.06
    again = load(tmp_path / "out")
    body = body_of((5, 2, 3))
    assert again.infer(body, deformed(body)).shape == (body.nodes, 6)
    with (tmp_path / "out" / "training.csv").open() as lines:
        assert [int(r["step"]) for r in csv.DictReader(lines)] == [80, 160, 240]
    # A second call finds the finished training in scratch and ends with the same weights.
    train(small_dataset, options, tmp_path / "again", tmp_path / "scratch")
    first, second = (torch.load(tmp_path / d / "weights.pt") for d in ("out", "again"))
    assert all(torch.equal(first[k], second[k]) for k in first)


def test_a_missing_network_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match="train it again"):
        load(tmp_path)
