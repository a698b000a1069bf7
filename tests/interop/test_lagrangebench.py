"""The LagrangeBench layout: its documented keys and statistics, there and back, and what cannot come over.

Where `ZSDT_LAGRANGEBENCH_PYTHON` names a Python that has the package, its own loader reads our files as well.
"""

import json
import os
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.tignn.conftest import make_body, make_trajectory
from tests.tignn.liquid_bodies import PITCH, make_flow, make_liquid
from zsdt.errors import DataError, OptionError
from zsdt.fluid.vessel import Vessel
from zsdt.interop.lagrangebench import LagrangeBenchOptions, Unit, export_lagrangebench
from zsdt.interop.lagrangebench_import import import_lagrangebench
from zsdt.trajectory import Dataset, DatasetEntry, Trajectory, write_index, write_trajectory

FRAMES = 12
# fmt: off
DOCUMENTED = [
    "case", "solver", "density_evolution", "dim", "dx", "dt", "t_end", "viscosity", "p_bg_factor", "g_ext_magnitude",
    "artificial_alpha", "free_slip", "write_every", "is_bc_trick", "sequence_length_train", "num_trajs_train",
    "sequence_length_test", "num_trajs_test", "num_particles_max", "periodic_boundary_conditions", "bounds",
    "default_connectivity_radius", "vel_mean", "vel_std", "acc_mean", "acc_std",
]
# fmt: on


def dataset(folder: Path, trajectories: dict[str, list[Trajectory]], regime: str = "glycerin") -> Path:
    entries = []
    for split, found in trajectories.items():
        for k, trajectory in enumerate(found):
            name = f"{split}_{k}"
            trajectory.meta["name"] = name
            write_trajectory(folder / f"{name}.h5", trajectory)
            entries.append(DatasetEntry(f"{name}.h5", name, split, str(trajectory.meta["regime"]), "cylinder"))
    write_index(folder, entries)
    return folder


@pytest.fixture(scope="module")
def liquids(tmp_path_factory: pytest.TempPathFactory) -> Path:
    wide, narrow = make_liquid(seed=1), make_liquid(radius=0.018, seed=2)
    splits = {
        "train": [make_flow(wide, FRAMES, 1), make_flow(narrow, FRAMES, 2)],
        "val": [make_flow(wide, FRAMES, 3)],
        "test": [make_flow(narrow, FRAMES, 4)],
        "beyond": [make_flow(narrow, FRAMES, 5)],
    }
    return dataset(tmp_path_factory.mktemp("liquids"), splits)


def test_files_hold_what_the_loader_asks_for(tmp_path: Path, liquids: Path) -> None:
    metadata = export_lagrangebench(liquids, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "metadata.json").read_text()) == metadata
    assert [key for key in DOCUMENTED if key not in metadata] == []
    assert metadata["dx"] == PITCH and metadata["dt"] * metadata["write_every"] == 0.004
    changes, jumps, bounds = [], [], np.array(metadata["bounds"])
    for split, count in (("train", 2), ("valid", 1), ("test", 1)):
        with h5py.File(tmp_path / "out" / f"{split}.h5") as file:
            assert list(file) == [f"{k:05d}" for k in range(count)]
            for group in file.values():
                places, types = group["position"][:], group["particle_type"][:]
                assert places.dtype == np.float32 and places.shape == (FRAMES, len(types), 3)
                assert len(places) == metadata["sequence_length_train"] + 1
                assert len(types) <= metadata["num_particles_max"]
                assert (places >= bounds[:, 0]).all() and (places <= bounds[:, 1]).all()
                walls = places[:, types == 1]
                assert len(walls[0]) > 100 and np.ptp(walls, axis=0).max() == 0, "walls stand still"
                fluid = places[:, types == 0].astype(np.float64)
                changes.append(fluid[1:] - fluid[:-1])
                jumps.append(changes[-1][1:] - changes[-1][:-1])
    for name, found in (("vel", changes), ("acc", jumps)):
        mean = np.mean([f.mean((0, 1)) for f in found], axis=0)
        spread = np.sqrt(np.mean([np.square(f - mean).mean((0, 1)) for f in found], axis=0))
        assert np.allclose(metadata[f"{name}_mean"], mean, rtol=1e-9, atol=1e-15)
        assert np.allclose(metadata[f"{name}_std"], spread, rtol=1e-6)


def test_particles_of_the_wall_lie_on_the_wall(tmp_path: Path, liquids: Path) -> None:
    metadata = export_lagrangebench(liquids, tmp_path / "out")
    trajectory = Dataset(liquids).read(Dataset(liquids).split("test")[0])
    with h5py.File(tmp_path / "out" / "test.h5") as file:
        places, types = file["00000/position"][0], file["00000/particle_type"][:]
    places = places.astype(float) - metadata["zsdt"]["shift"]
    assert np.allclose(places[types == 0], trajectory.fields["position"][0], atol=1e-7)
    assert trajectory.body.vessel is not None
    assert np.abs(Vessel(trajectory.body.vessel).distance(places[types == 1])).max() < 0.02 * PITCH
    bare = export_lagrangebench(liquids, tmp_path / "bare", LagrangeBenchOptions(walls=False))
    assert bare["num_particles_max"] == max(make_liquid(seed=1).nodes, make_liquid(radius=0.018, seed=2).nodes)


@pytest.mark.parametrize("unit", list(Unit))
def test_there_and_back_is_the_same_motion(tmp_path: Path, liquids: Path, unit: Unit) -> None:
    metadata = export_lagrangebench(liquids, tmp_path / "there", LagrangeBenchOptions(unit=unit))
    assert metadata["dx"] == (1.0 if unit is Unit.spacing else PITCH)
    entries = import_lagrangebench(tmp_path / "there", tmp_path / "back")
    before, after = Dataset(liquids), Dataset(tmp_path / "back")
    assert after.entries == entries and {e.name for e in entries} == {"train_0", "train_1", "val_0", "test_0"}
    for entry in entries:
        (origin,) = (e for e in before.entries if e.name == entry.name)
        assert (entry.split, entry.regime, entry.family) == (origin.split, origin.regime, origin.family)
        one, other = before.read(origin), after.read(entry)
        fluid = ~other.body.clamped
        assert fluid.sum() == one.body.nodes and np.isclose(other.body.pitch, PITCH)
        there = other.fields["position"][:, fluid] - other.fields["position"][0, 0]
        assert np.allclose(there, one.fields["position"] - one.fields["position"][0, 0], atol=2e-8)
        for name in ("velocity", "internal_energy"):
            assert np.array_equal(other.fields[name][:, fluid], one.fields[name])
        assert np.allclose(other.times, one.times, atol=1e-12)


def foreign(folder: Path, types: np.ndarray, **changes: object) -> Path:
    """A data set of somebody else in two dimensions: particles that fly straight on at 2 and -1 a time unit."""
    metadata = {"case": "DAM", "dim": 2, "dx": 0.02, "dt": 0.001, "write_every": 100, "bounds": [[0, 2], [0, 1]]}
    metadata |= {"periodic_boundary_conditions": [False, False], "g_ext_magnitude": 1.0, "viscosity": 0.01, **changes}
    folder.mkdir()
    (folder / "metadata.json").write_text(json.dumps({k: v for k, v in metadata.items() if v is not None}))
    start = np.random.default_rng(0).uniform(0.2, 0.8, (len(types), 2))
    straight = start + 0.1 * np.arange(6)[:, None, None] * np.array([2.0, -1.0]) * (types == 0)[:, None]
    with h5py.File(folder / "train.h5", "w") as file:
        file["00000/position"], file["00000/particle_type"] = straight.astype(np.float32), types
    return folder


def test_a_foreign_set_gets_velocities_held_walls_and_its_third_dimension(tmp_path: Path) -> None:
    types = np.array([0, 0, 0, 1, 2])
    (entry,) = import_lagrangebench(foreign(tmp_path / "dam", types), tmp_path / "ours")
    trajectory = Dataset(tmp_path / "ours").read(entry)
    assert entry.regime == "dam" and trajectory.body.pitch == 0.02
    assert np.allclose(trajectory.times, 0.1 * np.arange(6))
    assert np.array_equal(trajectory.body.clamped, types > 0)
    moving = trajectory.fields["velocity"][:, types == 0]
    assert np.allclose(moving, [2.0, -1.0, 0.0], atol=1e-5)
    assert np.abs(trajectory.fields["velocity"][:, types > 0]).max() == 0


@pytest.mark.parametrize(
    ("types", "changes", "sentence"),
    [
        ([0, 1], {"periodic_boundary_conditions": [True, False]}, "periodic"),
        ([0, 3], {}, "rigid bodies"),
        ([0, 8], {}, "particle type 8"),
        ([0, 1], {"dt": None}, "does not say dt"),
        ([0, 1], {"dim": 3}, "position has the shape"),
        ([0, 1], {"dim": 4}, "dim = 4"),
    ],
)
def test_what_has_no_place_here_is_refused_in_a_sentence(
    tmp_path: Path, types: list[int], changes: dict[str, object], sentence: str
) -> None:
    with pytest.raises(DataError, match=sentence):
        import_lagrangebench(foreign(tmp_path / "theirs", np.array(types), **changes), tmp_path / "ours")
    assert not (tmp_path / "ours").exists()


def test_broken_files_are_named(tmp_path: Path) -> None:
    folder = foreign(tmp_path / "theirs", np.array([0, 0]))
    (folder / "train.h5").write_bytes(b"not HDF5")
    with pytest.raises(DataError, match=r"train\.h5 is broken"):
        import_lagrangebench(folder, tmp_path / "ours")
    with pytest.raises(DataError, match=r"metadata\.json cannot be read"):
        import_lagrangebench(tmp_path, tmp_path / "ours")


def test_sets_that_the_layout_cannot_hold_say_what_to_do(tmp_path: Path) -> None:
    slow, fast = make_trajectory(make_body(), 8), make_trajectory(make_body(), 9)
    fast.meta["regime"] = "dynamic"
    mixed = dataset(tmp_path / "mixed", {"train": [slow, fast]})
    with pytest.raises(DataError, match="--regime"):
        export_lagrangebench(mixed, tmp_path / "out")
    metadata = export_lagrangebench(mixed, tmp_path / "out", LagrangeBenchOptions(regime="dynamic"))
    assert metadata["num_trajs_train"] == 1 and metadata["case"] == "BEAM"
    coarse = dataset(tmp_path / "coarse", {"train": [make_trajectory(make_body(pitch=p), 8) for p in (0.02, 0.05)]})
    with pytest.raises(DataError, match="--unit spacing"):
        export_lagrangebench(coarse, tmp_path / "other")
    assert export_lagrangebench(coarse, tmp_path / "other", LagrangeBenchOptions(unit=Unit.spacing))["dx"] == 1.0
    with pytest.raises(DataError, match="no train"):
        export_lagrangebench(mixed, tmp_path / "none", LagrangeBenchOptions(regime="ramp"))
    with pytest.raises(OptionError, match="rim"):
        LagrangeBenchOptions(rim=-1.0)


# Its loader alone: the package as a whole imports graph networks that want an old Python.
LOADER = """
import importlib.util, sys, types
import numpy as np
package = types.ModuleType("lagrangebench")
package.__path__ = list(importlib.util.find_spec("lagrangebench").submodule_search_locations)
sys.modules["lagrangebench"] = package
from lagrangebench.data import H5Dataset
from lagrangebench.data.utils import get_dataset_stats
folder, frames = sys.argv[1], int(sys.argv[2])
train = H5Dataset("train", folder, input_seq_length=6)
valid = H5Dataset("valid", folder, input_seq_length=6, split_valid_traj_into_n=1, is_rollout=True)
assert len(train) == 2 * (frames - 6 - 1), len(train)
window, types = train[0]
assert window.shape == (len(types), 7, 3), window.shape
whole, kinds = valid[0]
assert whole.shape == (len(kinds), frames, 3), whole.shape
stats = get_dataset_stats(train.metadata, False, 0.0)
assert np.isfinite(np.array(stats["velocity"]["std"])).all()
np.save(sys.argv[3], whole)
"""


def test_their_own_loader_reads_our_files(tmp_path: Path, liquids: Path) -> None:
    python = os.environ.get("ZSDT_LAGRANGEBENCH_PYTHON")
    if not python:
        pytest.skip("ZSDT_LAGRANGEBENCH_PYTHON names no Python with the package lagrangebench")
    export_lagrangebench(liquids, tmp_path / "out")
    words = [python, "-c", LOADER, str(tmp_path / "out"), str(FRAMES), str(tmp_path / "whole.npy")]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(words, capture_output=True, text=True, env={**clean, "JAX_PLATFORMS": "cpu"}, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    with h5py.File(tmp_path / "out" / "valid.h5") as file:
        assert np.array_equal(np.load(tmp_path / "whole.npy"), file["00000/position"][:].transpose(1, 0, 2))
