"""The command that exports: which source becomes what, and one sentence where it cannot."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from pipelines.export import main
from tests.tignn.conftest import make_body, make_trajectory, unit_model
from tests.tignn.liquid_bodies import make_flow, make_liquid
from zsdt.shipped import shipped
from zsdt.tignn.node_engine import save_engine
from zsdt.tignn.options import TignnOptions
from zsdt.trajectory import Dataset, DatasetEntry, write_index, write_trajectory


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    folder, entries = tmp_path / "data", []
    for split, number in (("train", 0), ("train", 1), ("test", 2)):
        made = make_trajectory(make_body(), 5, seed=number)
        made.meta["name"] = f"{split}_{number}"
        write_trajectory(folder / f"{made.name}.h5", made)
        entries.append(DatasetEntry(f"{made.name}.h5", made.name, split, "hand", "made"))
    write_index(folder, entries)
    return folder


def steps(path: Path) -> int:
    with h5py.File(path) as file:
        return int(file["VTKHDF/Steps"].attrs["NSteps"])


def artifact(folder: Path, stage: str, **more: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "manifest.json").write_text(json.dumps({"stage": stage, **more}))
    return folder


def test_a_data_set_becomes_a_file_for_each_trajectory(tmp_path: Path, dataset: Path) -> None:
    assert main(["vtk", str(dataset), str(tmp_path / "all")]) == 0
    assert {p.name for p in (tmp_path / "all").iterdir()} == {f"{n}.vtkhdf" for n in ("train_0", "train_1", "test_2")}
    assert main(["vtk", str(dataset), str(tmp_path / "some"), "--split", "train", "--limit", "1"]) == 0
    assert [p.name for p in (tmp_path / "some").iterdir()] == ["train_0.vtkhdf"]
    assert main(["vtk", str(dataset / "test_2.h5"), str(tmp_path / "one")]) == 0
    assert steps(tmp_path / "one" / "test_2.vtkhdf") == 5


def test_a_twin_becomes_a_file_with_what_it_estimated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = artifact(tmp_path / "twin", "twin")
    assert main(["vtk", str(folder), str(tmp_path / "out")]) == 1
    assert "kept no states" in capsys.readouterr().err
    made = make_flow(make_liquid(), 4, name="twin_closed")
    made.meta["frame_data"] = {"viscosity_over_told": [1.0, None, 1.2, 1.1]}
    made.load[:] = np.nan
    write_trajectory(folder / "twin.h5", made)
    assert main(["vtk", str(folder), str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "twin_closed_vessel.vtkhdf").is_file()
    with h5py.File(tmp_path / "out" / "twin_closed.vtkhdf") as file:
        told = file["VTKHDF/FieldData/viscosity_over_told"][:]
        assert np.array_equal(told, [1.0, np.nan, 1.2, 1.1], equal_nan=True)
        assert "load" not in file["VTKHDF/PointData"]


def test_an_evaluation_is_rolled_out_again_by_its_own_engines(
    tmp_path: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shelves = tmp_path / "outputs" / "artifacts"
    (shelves / "synthesize").mkdir(parents=True)
    dataset.rename(shelves / "synthesize" / "aa")
    model = unit_model(TignnOptions(width=8, passes=1, local_passes=1)).float()
    with torch.no_grad():
        for values in model.parameters():
            values.mul_(0.5)
    save_engine(model, shelves / "train_tignn" / "bb")
    folder = artifact(shelves / "evaluate" / "cc", "evaluate", inputs={"dataset": "aa", "train_tignn": "bb"})
    assert main(["vtk", str(folder), str(tmp_path / "out"), "--frames", "3"]) == 0
    (path,) = (tmp_path / "out" / "trained").iterdir()
    assert path.name == "test_2.vtkhdf" and steps(path) == 3
    with h5py.File(path) as file:
        assert "position_error" in file["VTKHDF/PointData"]
    shutil.rmtree(shelves / "train_tignn" / "bb")
    assert main(["vtk", str(folder), str(tmp_path / "out")]) == 1
    assert "bb" in capsys.readouterr().err


def test_lagrangebench_goes_in_the_direction_that_the_source_asks_for(
    tmp_path: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there, back = tmp_path / "there", tmp_path / "back"
    assert main(["lagrangebench", str(dataset), str(there), "--unit", "spacing"]) == 0
    assert main(["lagrangebench", str(there), str(back)]) == 0
    assert {e.name for e in Dataset(back).entries} == {"train_0", "train_1", "test_2"}
    assert main(["lagrangebench", str(there), str(back)]) == 1
    assert "is there already" in capsys.readouterr().err


def test_one_sentence_where_it_cannot(tmp_path: Path, dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, sentence in (
        (["vtk", str(tmp_path / "none"), "x"], "There is no"),
        (["vtk", str(tmp_path), "x"], "holds no data set"),
        (["vtk", str(dataset), "x", "--name", "nobody"], "has no such trajectories"),
        (["lagrangebench", str(tmp_path), "x"], "holds no data set"),
        (["onnx", str(tmp_path), "x"], "holds no trained network"),
        (["onnx", str(shipped("foam_beam", "tignn")), "x"], "sub-step form 'cell'"),
        (["onnx", str(shipped("glycerin_glass", "tignn")), "x"], "sub-step form 'particle'"),
    ):
        assert main(words) == 1
        error = capsys.readouterr().err
        assert error.startswith("error: ") and sentence in error and "Traceback" not in error
