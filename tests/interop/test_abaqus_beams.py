"""The published Abaqus beams in this program's terms: units, loads at their frames, grid, splits."""

import h5py
import numpy as np
import pytest
import torch

from zsdt.errors import DataError
from zsdt.files import data_root
from zsdt.graph import brick_grid
from zsdt.interop.abaqus_beams import AbaqusOptions, bricks_of, convert, source_files
from zsdt.trajectory import Dataset

PUBLISHED = data_root() / "abaqus_beams" / "abaqus_beams_dev.h5"
needs_data = pytest.mark.skipif(not PUBLISHED.is_file(), reason=f"the Abaqus beams are not at {PUBLISHED}")

COUNTS, STEPS = (3, 1, 1), 4


def small_beam(seed=0):
    """A made-up beam in the units of the publication (cm, cm/s, Pa, Pa cm2) with its nodes in a mixed order."""
    random = np.random.default_rng(seed)
    grid = brick_grid(COUNTS, 2.0)
    order = np.random.default_rng(7).permutation(len(grid.points))
    place = np.argsort(order)
    points, pairs = grid.points[order], place[grid.pairs]
    z = random.normal(size=(STEPS + 1, len(points), 12)).astype(np.float32)
    z[0, :, :3], z[0, :, 6:] = points, 0.0
    edge_index = np.concatenate([pairs, pairs[:, ::-1]]).T
    f = random.normal(size=(STEPS, len(points), 3)).astype(np.float32)
    return z, f, edge_index, points[:, 0] > 0


def write_hdf5(path, split=("train", "val")):
    z, f, edge_index, free = small_beam()
    with h5py.File(path, "w") as file:
        file["edge_index"], file["is_free"] = edge_index, free
        for number, name in enumerate(split, start=1):
            group = file.create_group(f"beam_{number:02d}")
            group.attrs["split"] = name
            group["z"], group["f"] = z, f


def write_pt(folder, data_class, numbers):
    folder.mkdir()
    z, f, edge_index, free = small_beam()
    n = torch.tensor(np.stack([free, ~free], axis=1).astype(np.float32))
    edges = torch.tensor(edge_index)
    steps = [
        data_class(x=torch.tensor(z[t]), y=torch.tensor(z[t + 1]), f=torch.tensor(f[t]), n=n, edge_index=edges)
        for t in range(STEPS)
    ]
    for number in numbers:
        torch.save(steps, folder / f"beam_{number}.pt")


@pytest.fixture
def converted(tmp_path):
    write_hdf5(tmp_path / "beams.h5")
    convert(AbaqusOptions(str(tmp_path / "beams.h5")), tmp_path / "out")
    return Dataset(tmp_path / "out")


def test_units_frames_and_loads(converted):
    z, f, _, free = small_beam()
    trajectory = converted.read(converted.split("train")[0])
    body = trajectory.body
    np.testing.assert_allclose(trajectory.fields["position"], z[..., :3] * 0.01, rtol=1e-6)
    np.testing.assert_allclose(trajectory.fields["velocity"], z[..., 3:6] * 0.01, rtol=1e-6)
    np.testing.assert_allclose(trajectory.fields["stress"], z[..., 6:], rtol=1e-6)
    assert not trajectory.load[0].any()
    np.testing.assert_allclose(trajectory.load[1:], f * 1e-4, rtol=1e-6)
    np.testing.assert_array_equal(body.clamped, ~free)
    assert (body.pitch, body.frame_dt, body.material) == (0.02, 0.05, None)
    assert not body.gravity.any() and not body.mass.any()
    np.testing.assert_allclose(trajectory.times, 0.05 * np.arange(STEPS + 1))


def test_edges_are_undirected_and_bricks_join_them(converted):
    body = converted.read(converted.split("train")[0]).body
    assert (body.pairs[:, 0] < body.pairs[:, 1]).all() and len(np.unique(body.pairs, axis=0)) == len(body.pairs)
    assert len(body.pairs) == len(brick_grid(COUNTS, 0.02).pairs)
    corners = body.points[body.cells] - body.points[body.cells][:, :1]
    wanted = [(a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1)]
    np.testing.assert_allclose(corners, np.broadcast_to(0.02 * np.array(wanted), corners.shape), atol=1e-9)
    assert len(body.cells) == 3


def test_a_mesh_that_is_no_grid_has_no_bricks_and_a_hole_stays_a_hole():
    grid = brick_grid((3, 3, 1), 0.02)
    assert len(bricks_of(grid.points + 0.004 * np.sin(40 * grid.points), 0.02)) == 0
    hollow = np.delete(grid.points, 5, axis=0)  # an inner node of the lower face
    assert len(bricks_of(hollow, 0.02)) == 9 - 4


@pytest.mark.parametrize("kind", ["Data", "OldData"])
def test_original_files_give_the_same_as_the_hdf5(geometric, converted, tmp_path, kind):
    write_pt(tmp_path / "clone", getattr(geometric, kind), [1, 12, 3])
    options = AbaqusOptions(str(tmp_path / "clone"), test=[12])
    assert [p.name for p in source_files(options)] == ["beam_1.pt", "beam_3.pt", "beam_12.pt"]
    summary = convert(options, tmp_path / "from_pt")
    assert summary["splits"] == {"train": 1, "val": 1, "test": 1}  # beam 1 validates in the published split
    dataset = Dataset(tmp_path / "from_pt")
    assert [e.name for e in dataset.split("test")] == ["beam_12"]
    ours, theirs = dataset.read(dataset.split("test")[0]), converted.read(converted.split("train")[0])
    for name, values in theirs.fields.items():
        np.testing.assert_array_equal(ours.fields[name], values)
    for name in ("points", "pairs", "cells", "clamped"):
        np.testing.assert_array_equal(getattr(ours.body, name), getattr(theirs.body, name))
    np.testing.assert_array_equal(ours.load, theirs.load)


def test_each_mistake_gives_its_own_sentence(geometric, tmp_path):
    write_hdf5(tmp_path / "beams.h5")
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.h5").write_text("no HDF5")
    cases = [
        (AbaqusOptions(str(tmp_path / "absent")), "There is nothing at"),
        (AbaqusOptions(str(tmp_path / "empty")), "holds no beams"),
        (AbaqusOptions(str(tmp_path / "text.h5")), "not a readable HDF5 file"),
        (AbaqusOptions(str(tmp_path / "beams.h5"), test=[1, 44]), "test beams 44 are not in"),
    ]
    write_pt(tmp_path / "other", geometric.Data, [1])
    torch.save([geometric.Data(x=torch.ones(3, 5))], tmp_path / "other" / "beam_1.pt")
    cases.append((AbaqusOptions(str(tmp_path / "other")), "are not those of the beam"))
    for options, words in cases:
        with pytest.raises(DataError, match=words) as caught:
            convert(options, tmp_path / "out")
        assert "\n" not in str(caught.value)


@needs_data
def test_load_of_a_frame_balances_the_stress_of_the_same_frame(tmp_path):
    """The finding on which the placement of the loads rests: section shear from stress, against the load."""
    convert(AbaqusOptions(), tmp_path)
    dataset = Dataset(tmp_path)
    assert len(dataset.split("train")) == 41 and len(dataset.split("val")) == 5
    for entry in dataset.split("val"):
        trajectory = dataset.read(entry)
        points = trajectory.body.points
        section = np.abs(points[:, 0] - 0.08) < 1e-6
        area = np.prod(np.where(np.isin(points[section, 1:].round(6), (0.0, 0.1)), 0.01, 0.02), axis=1)
        shear = np.einsum("tnc,n->tc", trajectory.fields["stress"][:, section][..., [3, 4]], area)
        load = trajectory.load.sum(axis=1)[:, 1:]
        assert not load[0].any() and not shear[0].any()
        np.testing.assert_allclose(shear[1:5], load[1:5], rtol=0.02, atol=1e-3)
        steps = np.diff(trajectory.fields["position"], axis=0)
        velocity = trajectory.fields["velocity"]
        assert np.linalg.norm(steps - 0.025 * (velocity[1:] + velocity[:-1])) < 1e-3 * np.linalg.norm(steps)
