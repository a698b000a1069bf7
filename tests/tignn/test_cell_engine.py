"""The sub-step engine: its energy account, rest, symmetry, artifacts, and that its constants can be learned."""

import numpy as np
import pytest

from tests.tignn.cell_bodies import body_of, foam_constants, random_correction
from zsdt.errors import DataError, OptionError
from zsdt.evaluation.ledger import closure
from zsdt.tignn.cell_energy import CellOptions, CellStart, card_of, nominal_constants, start_constants
from zsdt.tignn.cell_engine import CellEngine, save_cell_engine
from zsdt.tignn.cell_fit import fit_constants, make_case
from zsdt.tignn.cell_probe import probe
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.trajectory import Trajectory


def at_rest(body):
    zero = np.zeros_like(body.points)
    return {"position": body.points.copy(), "velocity": zero}


def weightless(body):
    body.gravity = np.zeros(3)
    return body


def trajectory_of(body, frames, load):
    fields = {name: np.zeros((frames, *v.shape)) + v for name, v in at_rest(body).items()}
    return Trajectory(body, np.arange(frames) * body.frame_dt, fields, load)


def tip_load(body, frames, peak):
    load = np.zeros((frames, body.nodes, 3))
    tip = body.points[:, 0] > body.points[:, 0].max() - 1e-9
    load[:, tip] = np.sin(np.linspace(0, np.pi, frames))[:, None, None] * np.array([0.0, 0.3, -1.0]) * peak / tip.sum()
    return load


@pytest.mark.parametrize("corrected", [False, True])
def test_rest_stays_at_rest_for_a_thousand_frames(corrected):
    body = body_of((4, 2, 2), frame_dt=0.005)
    engine = CellEngine(foam_constants(), CellOptions(), random_correction() if corrected else None)
    engine.prepare(body)
    zero = np.zeros_like(body.points)
    state = engine.start(at_rest(body), zero)
    first = engine.read(state)
    for _ in range(1000):
        state = engine.step(state, zero, zero)
    last = engine.read(state)
    assert np.abs(last["position"] - first["position"]).max() < 1e-8
    assert np.abs(last["stress"] - first["stress"]).max() < 1e-4 * np.abs(first["stress"]).max()


@pytest.mark.parametrize("start", [CellStart.shift, CellStart.residual])
def test_both_starts_keep_the_given_first_frame_and_do_not_twitch(start):
    body = body_of((5, 2, 2))
    engine = CellEngine(foam_constants(), CellOptions(start=start))
    engine.prepare(body)
    given = at_rest(body)
    given["position"][:, 2] -= 0.02 * body.points[:, 0] ** 2  # not the model's own sag
    zero = np.zeros_like(body.points)
    state = engine.start(given, zero)
    np.testing.assert_allclose(engine.read(state)["position"], given["position"], atol=1e-15)
    for _ in range(20):
        state = engine.step(state, zero, zero)
    assert np.abs(engine.read(state)["position"] - given["position"]).max() < 1e-6


def test_free_vibration_turns_energy_into_heat_and_closes_the_account_at_second_order():
    gaps = []
    for substeps in (12, 24, 48):
        body = weightless(body_of((4, 2, 2), frame_dt=0.005))
        engine = CellEngine(foam_constants(), CellOptions(substeps=substeps), random_correction())
        trajectory = trajectory_of(body, 41, np.zeros((41, body.nodes, 3)))
        trajectory.fields["velocity"][0, :, 2] = 2.0 * body.points[:, 0]
        account = roll_out(engine, trajectory).account
        assert (np.diff(account["dissipated"]) >= 0).all()
        assert account["dissipated"][-1] > 0.2 * account["kinetic"][0]
        gaps.append(np.abs(closure(account)).max())
    assert gaps[-1] < 1e-3
    rates = np.log2(np.array(gaps[:-1]) / gaps[1:])
    assert (rates > 1.7).all() and (rates < 2.4).all()


@pytest.mark.parametrize("start", [CellStart.shift, CellStart.residual, CellStart.plain])
def test_energy_changes_by_the_work_of_the_ports(start):
    body = body_of((4, 2, 2), frame_dt=0.005)
    engine = CellEngine(foam_constants(), CellOptions(start=start), random_correction())
    rollout = roll_out(engine, trajectory_of(body, 61, tip_load(body, 61, 0.5)))
    assert np.abs(closure(rollout.account)).max() < 5e-3
    assert rollout.account["work_load"][-1] != 0.0


def test_probe_finds_the_brackets_degenerate_on_the_way():
    body = body_of((4, 2, 2), frame_dt=0.005)
    engine = CellEngine(foam_constants(), CellOptions(), random_correction())
    engine.prepare(body)
    load = tip_load(body, 11, 0.5)
    state = engine.start(at_rest(body), load[0])
    for frame in range(1, 11):
        state = engine.step(state, load[frame - 1], load[frame])
    found = probe(engine, state)
    for name in ("energy_residual", "entropy_leak", "energy_leak", "bulk_mdE"):
        assert found[name] < 1e-12, name
    assert found["entropy_production"] > 0


def test_without_memory_nothing_becomes_heat():
    body = weightless(body_of((3, 2, 2), frame_dt=0.005))
    engine = CellEngine(foam_constants(), CellOptions(memory=False))
    trajectory = trajectory_of(body, 21, np.zeros((21, body.nodes, 3)))
    trajectory.fields["velocity"][0, :, 1] = body.points[:, 0]
    account = roll_out(engine, trajectory).account
    assert (account["dissipated"] == 0).all()
    total = account["kinetic"] + account["elastic"]
    assert np.abs(total / total[0] - 1).max() < 5e-3


def test_a_turned_cross_section_gives_the_turned_motion():
    """Swapping y and z of body, load and gravity swaps them in the result: no direction is preferred."""
    swap = [0, 2, 1]
    first, second = body_of((4, 2, 3), frame_dt=0.005), body_of((4, 3, 2), frame_dt=0.005)
    second.gravity = first.gravity[swap]
    partner = np.lexsort((second.points[:, 0], second.points[:, 2], second.points[:, 1]))
    np.testing.assert_allclose(second.points[partner][:, swap], first.points, atol=1e-12)
    load = tip_load(first, 21, 0.4)
    turned = np.zeros_like(load)
    turned[:, partner] = load[:, :, swap]
    results = []
    for body, force in ((first, load), (second, turned)):
        engine = CellEngine(foam_constants(), CellOptions(), random_correction())
        results.append(roll_out(engine, trajectory_of(body, 21, force)).fields)
    ours, theirs = results[0], {k: v[:, partner] for k, v in results[1].items()}
    np.testing.assert_allclose(theirs["position"][..., swap], ours["position"], atol=1e-7)
    np.testing.assert_allclose(theirs["stress"][..., [0, 2, 1, 4, 3, 5]], ours["stress"], atol=0.05)


def test_result_does_not_depend_on_how_cells_and_nodes_are_numbered():
    body = body_of((4, 2, 2), frame_dt=0.005)
    rng = np.random.default_rng(0)
    order = rng.permutation(body.nodes)  # order[k]: old number of the new node k
    place = np.argsort(order)
    other = body_of((4, 2, 2), frame_dt=0.005)
    other.points, other.mass, other.clamped = body.points[order], body.mass[order], body.clamped[order]
    other.cells = place[body.cells][rng.permutation(len(body.cells))]
    load = tip_load(body, 21, 0.4)
    results = []
    for which, force in ((body, load), (other, load[:, order])):
        engine = CellEngine(foam_constants(), CellOptions(), random_correction())
        results.append(roll_out(engine, trajectory_of(which, 21, force)).fields)
    np.testing.assert_allclose(results[1]["position"][:, place], results[0]["position"], atol=1e-7)


def test_stress_of_a_uniform_stretch_is_exact_at_every_node():
    body = body_of((3, 2, 2))
    body.clamped[:] = False
    card = card_of(body)
    engine = CellEngine(nominal_constants(*card), CellOptions(start=CellStart.plain))
    engine.prepare(body)
    deformation = np.eye(3) + 0.05 * np.random.default_rng(1).standard_normal((3, 3))
    fields = at_rest(body)
    fields["position"] = body.points @ deformation.T
    stress = engine.read(engine.start(fields, np.zeros_like(body.points)))["stress"]
    green = 0.5 * (deformation.T @ deformation - np.eye(3))
    trace = np.trace(green)
    second = card[0] * trace * np.eye(3) + 2 * card[1] * (1 - card[2]) * (green - trace / 3 * np.eye(3))
    cauchy = deformation @ second @ deformation.T / np.linalg.det(deformation)
    expected = [cauchy[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(stress, np.tile(expected, (body.nodes, 1)), rtol=1e-9, atol=1e-6)


def test_given_stress_of_the_first_frame_is_carried_along_with_the_body():
    """A rigid turn after the start turns the given stress with it, whatever it was."""
    body = weightless(body_of((3, 2, 2)))
    body.clamped[:] = False
    engine = CellEngine(foam_constants(), CellOptions())
    engine.prepare(body)
    given = np.random.default_rng(2).standard_normal((body.nodes, 6)) * 100
    zero = np.zeros_like(body.points)
    state = engine.start({**at_rest(body), "stress": given}, zero)
    np.testing.assert_allclose(engine.read(state)["stress"], given, atol=1e-9)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    state.u[:-1] = body.points @ turn.T - body.points
    i, j = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    tensor = np.empty((body.nodes, 3, 3))
    tensor[:, i, j] = tensor[:, j, i] = given
    expected = (turn @ tensor @ turn.T)[:, i, j]
    np.testing.assert_allclose(engine.read(state)["stress"], expected, atol=1e-6)


def test_stress_mismatch_of_the_first_load_goes_with_that_load():
    body = body_of((5, 2, 2))
    truth = CellEngine(foam_constants(), CellOptions())
    truth.prepare(body)
    load = tip_load(body, 3, 0.5)
    load[0], load[2] = load[1], 0.0
    held = truth.read(truth.start(at_rest(body), load[0]))
    released = truth.read(truth.start(at_rest(body), np.zeros_like(load[0])))
    engine = CellEngine(nominal_constants(*card_of(body)), CellOptions())
    engine.prepare(body)
    state = engine.start({**at_rest(body), "stress": held["stress"]}, load[0])
    np.testing.assert_allclose(engine.read(state)["stress"], held["stress"], atol=1e-9)
    for _ in range(120):
        state = engine.step(state, load[2], load[2])
    errors = []
    for share in (state.load_share, 1.0):
        state.load_share = share
        errors.append(np.linalg.norm(engine.read(state)["stress"] - released["stress"]))
    assert errors[0] < 0.5 * errors[1]


def test_constants_are_found_again_from_data_of_the_model_itself():
    options = CellOptions(fit_every=2)
    truth = nominal_constants(*card_of(body_of()))
    cases = []
    for counts, frame_dt, peak in (((4, 2, 2), 0.005, 0.6), ((5, 2, 2), 1 / 60, 0.4)):
        body = body_of(counts, frame_dt=frame_dt)
        engine = CellEngine(truth, options)
        data = trajectory_of(body, 31, tip_load(body, 31, peak))
        rollout = roll_out(engine, data)
        own = engine.start(at_rest(body), data.load[0])
        data.fields["position"] = rollout.fields["position"] - rollout.fields["position"][0] + body.points + own.u[:-1]
        cases.append(make_case(data, start_constants(options), options))
    found = fit_constants(cases, start_constants(options), 4, False, False, lambda *_: None)
    found = fit_constants(cases, found, 12, True, False, lambda *_: None, prior=1e-5).named()
    for name in ("bulk", "shear", "g1", "tau"):
        assert found[name] == pytest.approx(truth.named()[name], rel=0.02), name


def test_artifact_comes_back_as_the_same_engine(tmp_path):
    body = body_of((4, 2, 2))
    options = CellOptions(hidden=7, start=CellStart.residual)
    engine = CellEngine(foam_constants(), options, random_correction(), name="mine")
    engine.readout.matrices[3] *= 1.1
    save_cell_engine(tmp_path, engine)
    again = load_engine(tmp_path)
    data = trajectory_of(body, 4, tip_load(body, 4, 0.2))
    ours, theirs = roll_out(engine, data), roll_out(again, data)
    assert again.name == "mine"
    for name in ours.fields:
        assert np.array_equal(ours.fields[name], theirs.fields[name])
    (tmp_path / "weights.pt").write_bytes(b"broken")
    with pytest.raises(DataError, match="train it again"):
        load_engine(tmp_path)


def test_bodies_without_cells_are_refused():
    body = body_of()
    assert CellEngine(foam_constants()).applies_to(body)
    body.cells = np.zeros((0, 8), np.int64)
    assert not CellEngine(foam_constants()).applies_to(body)
    with pytest.raises(OptionError, match="form=node"):
        CellEngine(foam_constants()).prepare(body)
