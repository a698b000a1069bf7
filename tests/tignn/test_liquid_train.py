"""Training of the liquid node form on tiny liquids: it learns, resumes where it was, and takes weights from water."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.tignn.liquid_bodies import make_flow, make_liquid
from zsdt.errors import DataError
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.tignn.liquid_body import LiquidBody
from zsdt.tignn.liquid_data import LiquidStream, clip_of, scales_of
from zsdt.tignn.options import Bracket, Energy, LiquidOptions, NoiseKind, TignnOptions, TrainingOptions, Walls
from zsdt.tignn.train import train_engine
from zsdt.trajectory import DatasetEntry, write_index, write_trajectory

torch.set_num_threads(1)
SMALL = {"width": 8, "passes": 1, "rank": 1}
FAST = TrainingOptions(steps=8, batch=2, check_every=4, checkpoint_every=4, holdout_count=1, unroll=3, noise=0.02)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three liquids of different sizes."""
    folder = tmp_path_factory.mktemp("liquids")
    entries = []
    for seed, radius in enumerate((0.014, 0.016, 0.018)):
        trajectory = make_flow(make_liquid(radius, 0.02, seed), seed=seed, name=f"flow_{seed}")
        write_trajectory(folder / f"{trajectory.name}.h5", trajectory)
        entries.append(DatasetEntry(f"{trajectory.name}.h5", trajectory.name, "train", "glycerin", "cylinder"))
    write_index(folder, entries)
    return folder


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return torch.load(folder / "weights.pt", weights_only=True)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


class Killed(Exception):
    pass


def test_a_killed_training_ends_as_if_it_had_not_been_killed(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = TignnOptions(**SMALL, energy=Energy.physical)
    figures = train_engine(dataset, options, FAST, tmp_path / "whole", tmp_path / "scratch_whole")
    assert figures["steps"] == 8 and figures["held_out"] == ["flow_2"]
    sample = LiquidStream.sample

    def dying(self: LiquidStream, step: int):
        if step == 6:
            raise Killed
        return sample(self, step)

    monkeypatch.setattr(LiquidStream, "sample", dying)
    with pytest.raises(Killed):
        train_engine(dataset, options, FAST, tmp_path / "cut", tmp_path / "scratch")
    monkeypatch.setattr(LiquidStream, "sample", sample)
    train_engine(dataset, options, FAST, tmp_path / "cut", tmp_path / "scratch")
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "cut"))

    engine, trajectory = load_engine(tmp_path / "cut"), make_flow(make_liquid(0.02, 0.02, 7))
    rollout = roll_out(engine, trajectory)
    assert rollout.diverged_at is None and (rollout.graph_milliseconds > 0).all()
    assert set(rollout.fields) == {"position", "velocity", "internal_energy"}
    assert {"kinetic", "potential", "internal", "work_of_ports"} == set(rollout.account)
    again = roll_out(load_engine(tmp_path / "cut"), trajectory)
    assert np.array_equal(again.fields["position"], rollout.fields["position"])


@pytest.mark.parametrize("walls", list(Walls))
def test_training_lowers_the_error_of_every_bracket(dataset: Path, tmp_path: Path, walls: Walls) -> None:
    training = replace(FAST, steps=30, check_every=10, unroll=1, learning_rate=1e-2, noise=0.0)
    forms = [(b, Energy.learned) for b in Bracket] + [(Bracket.exact, Energy.physical)]
    for bracket, energy in forms if walls is Walls.features else forms[-1:]:
        options = TignnOptions(**SMALL, bracket=bracket, energy=energy, liquid=LiquidOptions(walls=walls))
        out = tmp_path / f"{bracket.value}_{energy.value}"
        train_engine(dataset, options, training, out, tmp_path / f"scratch_{out.name}")
        lines = (out / "training.csv").read_text().splitlines()
        column = lines[0].split(",").index("loss_velocity")
        losses = [float(line.split(",")[column]) for line in lines[1:]]
        assert losses[-1] < 0.9 * losses[0], out.name


def test_warm_start_takes_the_weights_of_another_run(dataset: Path, tmp_path: Path) -> None:
    options = TignnOptions(**SMALL)
    train_engine(dataset, options, FAST, tmp_path / "water", tmp_path / "a")
    still = replace(FAST, steps=1, check_every=1, learning_rate=0.0)
    train_engine(dataset, options, still, tmp_path / "glycerin", tmp_path / "b", tmp_path / "water")
    assert same(weights(tmp_path / "water"), weights(tmp_path / "glycerin"))
    other = TignnOptions(**{**SMALL, "width": 12})
    with pytest.raises(DataError, match="another shape"):
        train_engine(dataset, other, FAST, tmp_path / "third", tmp_path / "c", tmp_path / "water")


def test_samples_depend_on_seed_and_step_and_stay_in_the_vessel() -> None:
    options, training = TignnOptions(**SMALL), TrainingOptions(steps=10, noise=0.5, unroll_from=0.0, unroll=4)
    clips = [clip_of(make_flow(make_liquid()), options)]
    one, two = (LiquidStream(clips, scales_of(clips), training, start) for start in (0, 3))
    first, second = list(one)[5][0], list(two)[2][0]
    assert np.array_equal(first.state.velocity, second.state.velocity) and first.frame == second.frame
    assert first.unroll == second.unroll and 1 <= first.unroll <= 4
    body = clips[0].body
    assert not np.array_equal(first.state.velocity, clips[0].velocity[first.frame])
    assert body.vessel.distance(first.state.position).min() > 0.99 * body.clearance
    seeds = replace(training, noise_kind=NoiseKind.multiplicative)
    start = LiquidStream(clips, scales_of(clips), seeds).sample(1)[0]
    true = clips[0].velocity[start.frame]
    assert np.array_equal(start.state.position, clips[0].position[start.frame])
    assert 0.3 < np.std((start.state.velocity / true)[np.abs(true) > 1e-9]) < 0.7


def test_scales_are_root_mean_squares() -> None:
    trajectory = make_flow(make_liquid())
    scales = scales_of([clip_of(trajectory, TignnOptions(**SMALL))])
    assert scales.velocity == pytest.approx(float(np.sqrt(np.mean(trajectory.fields["velocity"] ** 2))))
    assert scales.viscosity == pytest.approx(1.412 / 1261.0)


def test_a_liquid_without_internal_energy_is_refused() -> None:
    trajectory = make_flow(make_liquid())
    del trajectory.fields["internal_energy"]
    with pytest.raises(DataError, match="internal_energy"):
        clip_of(trajectory, TignnOptions())
    assert LiquidBody(trajectory.body, TignnOptions()).neighbours > 20
