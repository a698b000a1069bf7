"""Psi_ini of a liquid: its symmetries, what it must be silent about, and that it learns a flow that can be written."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.tignn.cell_bodies import body_of
from zsdt.errors import DataError, OptionError
from zsdt.fluid.sampling import fill
from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselFamily, VesselShape
from zsdt.tignn import psi_ini
from zsdt.tignn.psi_ini_liquid import LiquidPsiIni, LiquidPsiIniNetwork, LiquidPsiIniOptions, load, train
from zsdt.tignn.psi_ini_liquid_features import inputs_of, merge_inputs
from zsdt.tignn.vessel_history import FADING, history_of, swing_of
from zsdt.trajectory import Body, DatasetEntry, Trajectory, VesselMotion, write_index, write_trajectory

DT = 0.004


def stop(speed, ramp=0.02, heading=0.3):
    times = np.linspace(-0.05, 0.0, 51)
    along = np.clip(-times / ramp, 0.0, 1.0)[:, None] * speed * np.array([np.cos(heading), np.sin(heading), 0.0])
    return VesselMotion(times, along, np.tile([0.0, 0.0, -9.81], (51, 1)))


def liquid_body(shape=None, particles=150, speed=0.4, ramp=0.02, heading=0.3, seed=0):
    shape = shape or VesselShape(VesselFamily.tumbler, [0.0, 0.12], [0.028, 0.04])
    filled = fill(Vessel(shape), 0.04, particles, np.random.default_rng(seed))
    n = len(filled.points)
    return Body(
        points=filled.points,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(n, bool),
        mass=np.full(n, 1261.0 * filled.spacing**3),
        frame_dt=DT,
        pitch=filled.spacing,
        liquid=Liquid(),
        vessel=shape,
        motion=stop(speed, ramp, heading),
    )


def random_psi_ini(seed=0):
    torch.manual_seed(seed)
    options = LiquidPsiIniOptions(width=16, passes=2)
    network = LiquidPsiIniNetwork(options)
    with torch.no_grad():
        network.left.normal_()
    return LiquidPsiIni(network, options)


def turned(body, matrix):
    motion = VesselMotion(body.motion.times, body.motion.velocity @ matrix.T, body.motion.gravity @ matrix.T)
    return replace(body, points=body.points @ matrix.T, motion=motion)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_a_turned_or_mirrored_glass_has_the_turned_field(mirror):
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([1.0, mirror, 1.0])
    body, psi = liquid_body(), random_psi_ini()
    body = replace(body, points=body.points + 0.03 * body.points[:, [1]] * [0.0, 0.0, 1.0])
    after = turned(body, turn)
    one, two = psi.infer_fields(body, body.points), psi.infer_fields(after, after.points)
    size = np.abs(one["velocity"]).max()
    assert size > 0.01
    np.testing.assert_allclose(two["velocity"], one["velocity"] @ turn.T, atol=1e-5 * size)
    heat = np.abs(one["internal_energy"]).max()
    np.testing.assert_allclose(two["internal_energy"], one["internal_energy"], atol=1e-5 * heat)


def test_a_vessel_that_never_changed_its_velocity_has_liquid_at_rest_exactly():
    body, even = liquid_body(), stop(0.4)
    even = VesselMotion(even.times, np.full_like(even.velocity, 0.3), even.gravity)
    found = random_psi_ini().infer_fields(replace(body, motion=even), body.points)
    assert not found["velocity"].any() and not found["internal_energy"].any()


SWING = swing_of(0.035, 0.05, 9.81, 1.12e-3)


def jump(at=-0.1):
    times = np.array([at - 0.1, at - 1e-6, at + 1e-6, 0.0])
    velocity = np.array([[0.5, 0, 0], [0.5, 0, 0], [0, 0, 0], [0, 0, 0]])
    return VesselMotion(times, velocity, np.tile([0.0, 0.0, -9.81], (4, 1)))


def test_pushes_fade_with_the_age_of_a_change_or_swing_with_the_first_mode():
    found = history_of(jump(), SWING, later=0.02)
    count = len(FADING)
    np.testing.assert_allclose(found.pushes[:count, 0], 0.5 * np.exp(-0.12 / np.array(FADING)), rtol=1e-4)
    w, b = SWING.frequency, np.array(SWING.dampings)
    turn = np.sqrt(w**2 - b**2)
    swung = np.exp(-b * 0.12) * (np.cos(turn * 0.12) - b / turn * np.sin(turn * 0.12))
    np.testing.assert_allclose(found.pushes[count:, 0], 0.5 * swung, rtol=1e-4)
    assert 2.9 < w / (2 * np.pi) < 3.7  # Hz; linear theory of that glass


def test_energy_that_a_memory_has_lost_is_what_the_push_gave_less_what_is_left():
    found = history_of(jump(-1e-3), SWING, later=5.0)
    np.testing.assert_allclose(found.spent, 0.125, rtol=1e-3)
    assert found.heat == pytest.approx(0.125, rel=1e-3)
    fresh = history_of(jump(-1e-5), SWING)
    np.testing.assert_allclose(fresh.spent, 0.0, atol=1e-3)


def test_a_tilt_pushes_like_the_gravity_that_it_turns():
    times = np.linspace(-0.01, 0.0, 11)
    gravity = np.tile([0.0, 0.0, -9.81], (11, 1))
    gravity[:-1, 0] = 1.0
    found = history_of(VesselMotion(times, np.zeros((11, 3)), gravity), SWING)
    np.testing.assert_allclose(found.pushes[len(FADING) - 1, 0], 0.0095, rtol=0.05)


def test_result_does_not_depend_on_the_rest_of_the_batch():
    network = random_psi_ini().network
    parts = [inputs_of(b, b.points) for b in (liquid_body(), liquid_body(particles=100, speed=0.7))]
    with torch.no_grad():
        together = network(merge_inputs(parts))
        alone = [network(p) for p in parts]
    for k in range(2):
        assert torch.allclose(together[k], torch.cat([a[k] for a in alone]), atol=1e-5)


def test_a_body_without_vessel_or_history_is_refused():
    body, psi = liquid_body(), random_psi_ini()
    with pytest.raises(OptionError, match="how its vessel moved"):
        psi.infer_fields(replace(body, motion=None), body.points)
    with pytest.raises(OptionError, match="needs a liquid and its vessel"):
        psi.infer_fields(replace(body, vessel=None), body.points)


def test_senseless_options_are_refused():
    for bad in ({"width": 0}, {"frames": []}, {"frames": [-1]}, {"first_share": 1.5}):
        with pytest.raises(OptionError):
            LiquidPsiIniOptions(**bad)


def made_up(body, name):
    """A potential flow that dies out, the gradient of (push.x) z over the level, and heat at the walls."""
    frames = np.arange(4)
    decay = np.exp(-frames * DT / 0.08)[:, None, None]
    push = -np.diff(body.motion.velocity, axis=0).sum(0)
    x = body.points
    flow = (x[:, 2:] * push + (x @ push)[:, None] * [0.0, 0.0, 1.0]) / 0.04
    heat = 0.5 * (push @ push) * np.exp(-Vessel(body.vessel).distance(x) / 0.006)[:, None]
    fields = {
        "position": np.repeat(x[None], 4, axis=0),
        "velocity": 0.6 * flow * decay,
        "internal_energy": heat * (1.2 - 0.5 * decay),
    }
    return Trajectory(body, frames * DT, fields, np.zeros((4, body.nodes, 3)), meta={"name": name})


@pytest.fixture(scope="module")
def small_dataset(tmp_path_factory):
    folder, entries = tmp_path_factory.mktemp("flows"), []
    draw = np.random.default_rng(0)
    for k, split in enumerate(["train"] * 5 + ["val", "test"]):
        radii = list(draw.uniform(0.028, 0.04, 2))
        shape = VesselShape(VesselFamily.tumbler, [0.0, 0.12], radii)
        body = liquid_body(shape, 120, draw.uniform(0.2, 0.8), 0.02, draw.uniform(0, 6.28), seed=k)
        write_trajectory(folder / f"{k}.h5", made_up(body, f"flow_{k}"))
        entries.append(DatasetEntry(f"{k}.h5", f"flow_{k}", split, "glycerin", "tumbler"))
    write_index(folder, entries)
    return folder


OPTIONS = LiquidPsiIniOptions(width=24, passes=1, hidden_layers=1, steps=150, frames=[0, 1, 3], check_every=50)


@pytest.fixture(scope="module")
def trained(small_dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("psi_ini")
    return folder, train(small_dataset, OPTIONS, folder / "out", folder / "scratch")


def test_it_learns_a_flow_in_a_vessel_that_it_has_not_seen(trained):
    test = trained[1]["test"]
    assert test["velocity_rrmse"] < 0.25 < 0.5 < test["velocity_rrmse_constant"]
    assert max(test[f"velocity_rmse_{axis}"] for axis in "xyz") < 0.5 * test["velocity_rms"]
    assert test["internal_energy_rrmse"] < 0.4


def test_what_is_written_is_read_back_by_either_door(trained, small_dataset):
    folder = trained[0] / "out"
    body = liquid_body(speed=0.5)
    one, two = load(folder).infer_fields(body, body.points), psi_ini.load(folder).infer_fields(body, body.points)
    assert isinstance(psi_ini.load(folder), LiquidPsiIni)
    np.testing.assert_array_equal(one["velocity"], two["velocity"])
    assert one["internal_energy"].shape == (body.nodes, 1)
    with (folder / "training.csv").open() as lines:
        assert [int(r["step"]) for r in csv.DictReader(lines)] == [50, 100, 150]


def test_a_killed_training_goes_on_to_the_same_weights(trained, small_dataset, tmp_path, monkeypatch):
    from zsdt.tignn import psi_ini_liquid

    calm = psi_ini_liquid._loss

    def killed(network, examples, rng):
        if list((tmp_path / "scratch").glob("*.pt")):
            raise KeyboardInterrupt
        return calm(network, examples, rng)

    monkeypatch.setattr(psi_ini_liquid, "_loss", killed)
    with pytest.raises(KeyboardInterrupt):
        train(small_dataset, OPTIONS, tmp_path / "out", tmp_path / "scratch")
    monkeypatch.setattr(psi_ini_liquid, "_loss", calm)
    train(small_dataset, OPTIONS, tmp_path / "out", tmp_path / "scratch")
    first, second = (torch.load(d / "weights.pt") for d in (trained[0] / "out", tmp_path / "out"))
    assert all(torch.equal(first[k], second[k]) for k in first)


def test_missing_broken_and_foreign_networks_are_one_sentence(trained, tmp_path):
    with pytest.raises(DataError, match="train it again"):
        load(tmp_path)
    good = trained[0] / "out"
    card = json.loads((good / "psi_ini.json").read_text())
    for change in ({"kind": "solid"}, {"width": 7}, {"colour": 1}):
        (tmp_path / "psi_ini.json").write_text(json.dumps({**card, **change}))
        (tmp_path / "weights.pt").write_bytes((good / "weights.pt").read_bytes())
        with pytest.raises(DataError, match="train it again"):
            load(tmp_path)
    (tmp_path / "psi_ini.json").write_text(json.dumps({**card, "kind": "gas"}))
    with pytest.raises(DataError, match="known are solid and liquid"):
        psi_ini.load(tmp_path)


def test_the_solid_kind_names_its_field():
    options = psi_ini.PsiIniOptions(width=8, passes=1)
    solid, body = psi_ini.PsiIni(psi_ini.PsiIniNetwork(options), options), body_of()
    found = solid.infer_fields(body, body.points)
    assert list(found) == ["stress"] and found["stress"].shape == (body.nodes, 6)
