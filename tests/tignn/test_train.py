"""Training on tiny bodies: it learns, resumes where it was, repeats itself, and refuses what cannot be trained."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.tignn.conftest import make_body, make_trajectory
from zsdt.errors import DataError, OptionError
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.tignn.model import NodeModel
from zsdt.tignn.node_data import SampleStream, clip_of, scales_of
from zsdt.tignn.options import Bracket, Energy, NoiseKind, TignnOptions, TrainingOptions
from zsdt.tignn.train import train_engine
from zsdt.trajectory import DatasetEntry, write_index, write_trajectory

SMALL = {"width": 8, "passes": 1, "local_passes": 1, "rank": 1}
FAST = TrainingOptions(steps=8, batch=2, check_every=4, checkpoint_every=4, holdout_count=1, unroll=2)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three bodies of different sizes, so that every batch mixes graphs."""
    folder = tmp_path_factory.mktemp("data")
    entries = []
    for seed, counts in enumerate([(3, 1, 1), (4, 1, 2), (2, 2, 2)]):
        trajectory = make_trajectory(make_body(counts, seed=seed), seed=seed)
        write_trajectory(folder / f"trajectories/{trajectory.name}.h5", trajectory)
        entries.append(DatasetEntry(f"trajectories/{trajectory.name}.h5", trajectory.name, "train", "hand", "test"))
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
    options = TignnOptions(**SMALL)
    figures = train_engine(dataset, options, FAST, tmp_path / "whole", tmp_path / "scratch_whole")
    assert figures["steps"] == 8 and figures["seconds_per_1000_steps"] > 0

    sample = SampleStream.sample

    def dying(self: SampleStream, step: int):
        if step == 6:
            raise Killed
        return sample(self, step)

    monkeypatch.setattr(SampleStream, "sample", dying)
    with pytest.raises(Killed):
        train_engine(dataset, options, FAST, tmp_path / "cut", tmp_path / "scratch")
    monkeypatch.setattr(SampleStream, "sample", sample)
    train_engine(dataset, options, FAST, tmp_path / "cut", tmp_path / "scratch")
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "cut"))

    # Killed between the last step and the artifact: nothing is trained again.
    train_engine(dataset, options, FAST, tmp_path / "again", tmp_path / "scratch")
    assert same(weights(tmp_path / "again"), weights(tmp_path / "cut"))

    rows = [(tmp_path / name / "training.csv").read_text().splitlines() for name in ("whole", "cut")]
    assert len(rows[0]) == len(rows[1]) == 3
    rollout = roll_out(load_engine(tmp_path / "cut"), make_trajectory(make_body((5, 1, 1))))
    assert rollout.diverged_at is None and rollout.fields["stress"].shape[2] == 6


def test_training_lowers_the_error_of_every_bracket(dataset: Path, tmp_path: Path) -> None:
    training = replace(FAST, steps=30, check_every=10, unroll=1, learning_rate=1e-2, noise=0.0, augment=False)
    for bracket in Bracket:
        options = TignnOptions(**SMALL, bracket=bracket)
        train_engine(dataset, options, training, tmp_path / bracket.value, tmp_path / f"scratch_{bracket.value}")
        lines = (tmp_path / bracket.value / "training.csv").read_text().splitlines()
        column = lines[0].split(",").index("loss_stress")
        losses = [float(line.split(",")[column]) for line in lines[1:]]
        assert losses[-1] < 0.9 * losses[0]


def test_warm_start_takes_the_weights_of_another_run(dataset: Path, tmp_path: Path) -> None:
    options = TignnOptions(**SMALL)
    train_engine(dataset, options, FAST, tmp_path / "first", tmp_path / "a")
    still = replace(FAST, steps=1, check_every=1, learning_rate=0.0)
    train_engine(dataset, options, still, tmp_path / "second", tmp_path / "b", tmp_path / "first")
    assert same(weights(tmp_path / "first"), weights(tmp_path / "second"))
    other = TignnOptions(**{**SMALL, "width": 12})
    with pytest.raises(DataError, match="another shape"):
        train_engine(dataset, other, FAST, tmp_path / "third", tmp_path / "c", tmp_path / "first")


def test_early_stop_ends_a_training_that_gains_nothing(dataset: Path, tmp_path: Path) -> None:
    still = replace(FAST, steps=40, check_every=2, learning_rate=0.0, patience=2, tensorboard=True)
    figures = train_engine(dataset, TignnOptions(**SMALL), still, tmp_path / "out", tmp_path / "scratch")
    assert figures["steps"] < 40
    assert list((tmp_path / "scratch").rglob("events.out.tfevents*"))


def test_scales_are_root_mean_squares_of_a_field() -> None:
    trajectory = make_trajectory(make_body())
    scales = scales_of([trajectory], TignnOptions(energy=Energy.learned, split_pressure=False))
    assert scales.velocity == pytest.approx(float(np.sqrt(np.mean(trajectory.fields["velocity"] ** 2))))
    assert scales.pressure == scales.deviator
    split = scales_of([trajectory], TignnOptions())
    assert split.pressure**2 + 5 * split.deviator**2 == pytest.approx(6 * scales.pressure**2)


def test_a_sample_depends_on_seed_and_step_alone() -> None:
    trajectory = make_trajectory(make_body())
    options, training = TignnOptions(**SMALL), TrainingOptions(steps=10)
    clips, scales = [clip_of(trajectory, options)], scales_of([trajectory], options)
    one, two = (SampleStream(clips, scales, options, training, start) for start in (0, 3))
    first, second = list(one)[5], list(two)[2]
    assert torch.equal(first.state.stress, second.state.stress) and torch.equal(first.loads, second.loads)


@pytest.mark.parametrize("kind", list(NoiseKind))
def test_noise_leaves_the_target_and_the_clamp_alone(kind: NoiseKind) -> None:
    trajectory = make_trajectory(make_body())
    options = TignnOptions(**SMALL)
    training = TrainingOptions(steps=1, noise=0.1, augment=False, unroll_from=1.0, noise_kind=kind)
    clip = clip_of(trajectory, options)
    sample = next(iter(SampleStream([clip], scales_of([trajectory], options), options, training)))
    rows = slice(0, trajectory.body.nodes)
    assert any(torch.equal(sample.target.velocity[rows], s.velocity) for s in clip.states)
    assert not any(torch.equal(sample.state.velocity[rows], s.velocity) for s in clip.states)
    held = torch.as_tensor(trajectory.body.clamped)
    assert float(sample.state.displacement[rows][held].abs().max()) == 0.0


def test_recent_increments_are_those_of_the_trajectory() -> None:
    options = TignnOptions(**SMALL, history=2)
    trajectory = make_trajectory(make_body())
    trajectory.fields["velocity"] = trajectory.fields["velocity"] * np.arange(1, 9)[:, None, None] ** 2
    states = clip_of(trajectory, options).states
    step = np.diff(trajectory.fields["velocity"], axis=0)
    assert np.allclose(states[3].increments.numpy(), np.concatenate([step[2], step[1]], axis=1), atol=1e-6)
    assert float(states[0].increments.abs().max()) == 0.0
    assert NodeModel(options, scales_of([trajectory], options)).options.history == 2


def test_physical_energy_needs_energies(dataset: Path, tmp_path: Path) -> None:
    bare = make_trajectory(make_body(), energies=False)
    options = TignnOptions(**SMALL, energy=Energy.physical, staggered=False)
    for needy in (clip_of, lambda t, o: scales_of([t], o)):
        with pytest.raises(OptionError, match="energy=learned"):
            needy(bare, options)
    figures = train_engine(dataset, options, replace(FAST, steps=4, check_every=4), tmp_path / "out", tmp_path / "s")
    assert np.isfinite(figures["best"]["rollout_score"])


def test_a_holdout_that_does_not_exist_is_named(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="made_9"):
        train_engine(dataset, TignnOptions(**SMALL), replace(FAST, holdout=["made_9"]), tmp_path / "o", tmp_path / "s")
