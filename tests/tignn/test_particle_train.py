"""Learning of the particle profiles: recovers what made the data, goes on after a kill, starts warm."""

import numpy as np
import pytest

import zsdt.tignn.particle_train as particle_train
from tests.tignn.particle_bodies import engine_for, equal_liquid, stirred
from zsdt.errors import DataError
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.tignn.options import Form, TignnOptions, TrainingOptions
from zsdt.tignn.particle_fit import Case, Fit, improve
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.tignn.particle_profiles import PROFILES, ParticleProfiles, start_profiles
from zsdt.tignn.train import train_engine
from zsdt.trajectory import Dataset, DatasetEntry, Trajectory, write_index, write_trajectory

SMALL = {"degree": 0, "substeps": 8, "fit_trajectories": 1, "fit_every": 2, "fit_rollouts": 2}


def shaken() -> ParticleProfiles:
    """Constants that differ from the textbook in what a short rollout shows."""
    plain = start_profiles(3.0, 0)
    for name, by in (("normal", 0.4), ("wall_friction", -0.5), ("wall_widening", -0.1)):
        plain.coefficients[PROFILES.index(name)] += by
    return plain


def made(frames: int = 8, seed: int = 0, name: str = "made") -> Trajectory:
    """A trajectory of the engine itself, with shaken profiles."""
    body = equal_liquid(depth=0.024)
    engine = engine_for(body, shaken(), degree=0, substeps=8)
    first = stirred(body, seed=seed)
    zero = np.zeros((frames, body.nodes, 3))
    fields = {k: np.repeat(v[None], frames, axis=0) for k, v in first.items()}
    seeded = Trajectory(body, np.arange(frames) * body.frame_dt, fields, zero, meta={"name": name})
    rollout = roll_out(engine, seeded)
    return Trajectory(body, seeded.times, rollout.fields, zero, meta={"name": name, "regime": "glycerin"})


def write_set(folder) -> Dataset:
    entries = []
    for k, split in enumerate(("train", "val")):
        write_trajectory(folder / f"{split}.h5", made(6, k, split))
        entries.append(DatasetEntry(f"{split}.h5", split, split, "glycerin", "cylinder"))
    write_index(folder, entries)
    return Dataset(folder)


def test_profiles_that_made_the_data_are_found_again():
    trajectory = made()
    engine = engine_for(trajectory.body, start_profiles(3.0, 0), degree=0, substeps=8)
    cases = [Case(trajectory, engine, 0, trajectory.frames - 1, 2, 0.5)]
    anchor = start_profiles(3.0, 0)
    fit = Fit(anchor)
    for _ in range(5):
        fit = improve(fit, cases, anchor, 1e-9)
    for name in ("normal", "wall_friction", "wall_widening"):
        k = PROFILES.index(name)
        assert fit.profiles.coefficients[k] == pytest.approx(shaken().coefficients[k], abs=0.05)
    assert fit.cost < 1e-5


def test_a_killed_training_goes_on_and_ends_the_same(tmp_path, monkeypatch):
    write_set(tmp_path)
    options = TignnOptions(form=Form.particle, particle=ParticleOptions(**SMALL))
    training = TrainingOptions(holdout_count=1)
    whole = train_engine(tmp_path, options, training, tmp_path / "whole", tmp_path / "a")
    assert whole["best"]["displacement"] < 0.5 * _first(tmp_path / "whole")
    calls = []

    def killed(*args):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return improve(*args)

    monkeypatch.setattr(particle_train, "improve", killed)
    with pytest.raises(KeyboardInterrupt):
        train_engine(tmp_path, options, training, tmp_path / "out", tmp_path / "b")
    train_engine(tmp_path, options, training, tmp_path / "out", tmp_path / "b")
    assert len(calls) == 3  # the first iteration is not done again
    one, two = load_engine(tmp_path / "whole"), load_engine(tmp_path / "out")
    assert np.array_equal(one.profiles.coefficients, two.profiles.coefficients)

    monkeypatch.setattr(particle_train, "improve", improve)
    rest = TignnOptions(form=Form.particle, particle=ParticleOptions(**{**SMALL, "fit_rollouts": 0}))
    warm = train_engine(tmp_path, rest, training, tmp_path / "warm", tmp_path / "c", tmp_path / "whole")
    assert warm["best"]["displacement"] == pytest.approx(whole["best"]["displacement"], rel=1e-9)
    other = TignnOptions(form=Form.particle, particle=ParticleOptions(**{**SMALL, "degree": 1}))
    with pytest.raises(DataError, match="another cutoff or degree"):
        train_engine(tmp_path, other, training, tmp_path / "no", tmp_path / "d", tmp_path / "whole")


def _first(folder) -> float:
    """Displacement error of the textbook profiles, the first row of the log."""
    lines = (folder / "training.csv").read_text().splitlines()
    return float(dict(zip(lines[0].split(","), lines[1].split(","), strict=True))["displacement"])
