"""A trajectory survives its file, the file explains itself, and a broken one says so in one sentence."""

import json

import h5py
import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.fields import FIELDS
from zsdt.graph import brick_grid
from zsdt.scene import Foam, Liquid, Modulus, VesselFamily, VesselShape
from zsdt.trajectory import (
    Body,
    Dataset,
    DatasetEntry,
    Trajectory,
    VesselMotion,
    read_trajectory,
    write_index,
    write_trajectory,
)


def trajectory(material=None):
    random = np.random.default_rng(0)
    grid = brick_grid((3, 2, 1), 0.05)
    nodes = len(grid.points)
    body = Body(
        grid.points, grid.pairs, grid.points[:, 0] == 0, random.uniform(size=nodes), 1 / 60, 0.05,
        cells=grid.cells, material=material,
    )  # fmt: skip
    fields = {
        name: random.normal(size=(5, nodes, known.components)) for name, known in FIELDS.items() if name != "load"
    }
    ledger = {"kinetic": random.uniform(size=5), "dissipated": np.arange(5.0)}
    meta = {"name": "beam_7", "regime": "hand", "shape": [0.15, 0.1, 0.05], "seed": 3}
    return Trajectory(body, np.arange(5) / 60, fields, random.normal(size=(5, nodes, 3)), ledger, meta)


@pytest.mark.parametrize("material", [None, Foam(), Foam(young=3e4, modulus=Modulus.long_term)])
def test_round_trip(tmp_path, material):
    wrote = trajectory(material)
    write_trajectory(tmp_path / "deep" / "t.h5", wrote)
    read = read_trajectory(tmp_path / "deep" / "t.h5")
    for name, values in wrote.fields.items():  # fields and loads are kept in single precision
        np.testing.assert_array_equal(read.fields[name], values.astype(np.float32))
    np.testing.assert_array_equal(read.load, wrote.load.astype(np.float32))
    for name, values in wrote.ledger.items():  # the account in double: its residuals are differences
        np.testing.assert_array_equal(read.ledger[name], values)
    for name in ("points", "pairs", "cells", "clamped", "mass", "gravity", "frame_dt", "pitch", "material"):
        np.testing.assert_array_equal(getattr(read.body, name), getattr(wrote.body, name))
    np.testing.assert_array_equal(read.times, wrote.times)
    assert read.meta == wrote.meta and read.name == "beam_7" and read.frames == 5
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["t.h5"]  # nothing is left beside it


def test_a_liquid_keeps_its_vessel_and_how_it_moved(tmp_path):
    wrote = trajectory()
    wrote.body.liquid = Liquid(viscosity=0.9)
    wrote.body.vessel = VesselShape(VesselFamily.jar, [0.0, 0.1], [0.04, 0.04], aspect=0.7, exponent=4.0)
    times = np.linspace(-0.1, 0.0, 7)
    wrote.body.motion = VesselMotion(times, np.outer(times, [1.0, 2.0, 0.0]), np.tile([0.0, 0.0, -9.81], (7, 1)))
    write_trajectory(tmp_path / "t.h5", wrote)
    read = read_trajectory(tmp_path / "t.h5").body
    assert read.liquid == wrote.body.liquid and read.vessel == wrote.body.vessel and read.material is None
    for name in ("times", "velocity", "gravity"):
        np.testing.assert_array_equal(getattr(read.motion, name), getattr(wrote.body.motion, name))


def test_a_file_of_version_1_is_still_read(tmp_path):
    write_trajectory(tmp_path / "t.h5", trajectory(Foam()))
    with h5py.File(tmp_path / "t.h5", "a") as file:
        file.attrs["schema_version"] = 1
    assert read_trajectory(tmp_path / "t.h5").body.vessel is None


def test_h5py_alone_finds_every_unit_and_description(tmp_path):
    write_trajectory(tmp_path / "t.h5", trajectory(Foam()))
    found = {}
    with h5py.File(tmp_path / "t.h5") as file:
        file.visititems(lambda name, item: found.update({name: dict(item.attrs)}) if hasattr(item, "shape") else None)
        assert (file.attrs["schema"], file.attrs["schema_version"]) == ("zsdt.trajectory", 2)
        assert json.loads(file.attrs["meta"])["name"] == "beam_7"
        assert json.loads(file["body"].attrs["material"])["young"] == 4.5e4
    assert all(attrs["unit"] and attrs["description"] for attrs in found.values())
    assert found["fields/stress"]["unit"] == "Pa" and "11 22 33 12 13 23" in found["fields/stress"]["description"]
    assert found["load"]["unit"] == "N" and found["ledger/kinetic"]["unit"] == "J"
    assert {f"fields/{name}" for name in FIELDS if name != "load"} <= set(found)


def assert_one_sentence(caught):
    text = str(caught.value)
    assert "\n" not in text and text.endswith(".") and "Traceback" not in text


@pytest.mark.parametrize("keep", [0.0, 0.02, 0.5, 0.95, 0.999])
def test_truncated_file(tmp_path, keep):
    path = tmp_path / "t.h5"
    write_trajectory(path, trajectory())
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(DataError, match=r"broken or truncated.*make it again") as caught:
        read_trajectory(path)
    assert_one_sentence(caught)


def test_missing_file_missing_part_and_foreign_file(tmp_path):
    with pytest.raises(DataError, match="There is no trajectory file") as caught:
        read_trajectory(tmp_path / "absent.h5")
    assert_one_sentence(caught)
    path = tmp_path / "t.h5"
    write_trajectory(path, trajectory())
    with h5py.File(path, "a") as file:
        del file["body/pairs"]
    with pytest.raises(DataError, match="broken or truncated") as caught:
        read_trajectory(path)
    assert_one_sentence(caught)


@pytest.mark.parametrize(("name", "value"), [("schema", "somebody.else"), ("schema_version", 99)])
def test_other_schema_is_named(tmp_path, name, value):
    path = tmp_path / "t.h5"
    write_trajectory(path, trajectory())
    with h5py.File(path, "a") as file:
        file.attrs[name] = value
    with pytest.raises(DataError, match=f"{value}.*reads zsdt.trajectory versions 1 and 2") as caught:
        read_trajectory(path)
    assert_one_sentence(caught)


def test_a_data_set_splits_and_reads_in_the_order_of_its_index(tmp_path):
    with pytest.raises(DataError, match=r"index\.csv is missing") as caught:
        Dataset(tmp_path)
    assert_one_sentence(caught)
    entries = [
        DatasetEntry(f"trajectories/{k}.h5", f"n{k}", split, regime, "foam")
        for k, (split, regime) in enumerate([("train", "hand"), ("test", "dynamic"), ("train", "dynamic")])
    ]
    for entry in entries:
        write_trajectory(tmp_path / entry.file, trajectory())
    write_index(tmp_path, entries)
    dataset = Dataset(tmp_path)
    assert dataset.entries == entries
    assert [e.name for e in dataset.split("train")] == ["n0", "n2"]
    assert [e.name for e in dataset.split("test", "train", regime="dynamic")] == ["n1", "n2"]
    assert dataset.read(entries[1]).name == "beam_7"
