"""Artifacts are built once, never half-written, and a disk that is full is named."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import pytest

from pipelines.store import Store, artifact_key, digest_of_files
from zsdt.errors import DataError


def build_slowly(out: Path, scratch: Path) -> dict[str, float]:
    """Leaves a trace beside the store, so that builds can be counted."""
    with (out.parents[2] / "builds.txt").open("a") as trace:
        trace.write("built\n")
    time.sleep(0.5)
    (out / "result.txt").write_text("42")
    return {"answer": 42}


def obtain(root: Path) -> None:
    """One process that wants the artifact."""
    artifact = Store(root / "artifacts").obtain("stage", "abc", build_slowly, dict)
    assert (artifact.path / "result.txt").read_text() == "42"


def test_two_processes_that_want_the_same_build_it_once(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=obtain, args=(tmp_path,)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    assert [process.exitcode for process in processes] == [0, 0]
    assert (tmp_path / "builds.txt").read_text() == "built\n"


def test_a_build_that_fails_leaves_only_its_scratch_folder(tmp_path: Path) -> None:
    store = Store(tmp_path)

    def build(out: Path, scratch: Path) -> dict[str, float]:
        (out / "half.txt").write_text("half")
        (scratch / "last.ckpt").write_text("step 7")
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        store.obtain("train", "abc", build, dict)
    assert store.find("train", "abc") is None
    assert not list(tmp_path.rglob("half.txt"))
    assert [path.read_text() for path in tmp_path.rglob("last.ckpt")] == ["step 7"]

    def resume(out: Path, scratch: Path) -> dict[str, str]:
        return {"from": (scratch / "last.ckpt").read_text()}

    artifact = store.obtain("train", "abc", resume, lambda: {"key": "abc"})
    assert artifact.manifest["figures"] == {"from": "step 7"}
    assert not list(tmp_path.rglob("last.ckpt"))


def test_what_a_killed_process_left_is_not_an_artifact(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for name in (".abc.part", "abc"):
        (tmp_path / "stage" / name).mkdir(parents=True)
        (tmp_path / "stage" / name / "half.txt").write_text("half")
    assert store.find("stage", "abc") is None
    artifact = store.obtain("stage", "abc", lambda out, scratch: {}, dict)
    assert sorted(path.name for path in artifact.path.iterdir()) == ["manifest.json"]


def test_key_changes_with_everything_that_counts() -> None:
    parts = {"stage": "a", "version": 1, "config": {"x": 1.0, "y": [1, 2]}, "inputs": {"data": "k"}}
    changed = [{"stage": "b"}, {"version": 2}, {"config": {"x": 1.5, "y": [1, 2]}}, {"inputs": {"data": "l"}}]
    keys = [artifact_key(**(parts | change)) for change in changed]
    assert len({artifact_key(**parts), *keys}) == 5
    assert artifact_key(**(parts | {"config": {"y": [1, 2], "x": 1.0}})) == artifact_key(**parts)


def test_digest_follows_contents_and_not_the_place(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "beam.h5").write_text("same")
    assert digest_of_files([tmp_path / "a/beam.h5"]) == digest_of_files([tmp_path / "b/beam.h5"])
    (tmp_path / "b/beam.h5").write_text("other")
    assert digest_of_files([tmp_path / "a/beam.h5"]) != digest_of_files([tmp_path / "b/beam.h5"])
    with pytest.raises(DataError, match="Could not read"):
        digest_of_files([tmp_path / "none.h5"])


def test_a_full_disk_is_named_and_leaves_nothing(small_disk: Path) -> None:
    store = Store(small_disk)

    def plain(out: Path, scratch: Path) -> dict[str, float]:
        (out / "weights.bin").write_bytes(bytes(8 << 20))
        return {}

    def hdf5(out: Path, scratch: Path) -> dict[str, float]:
        import h5py
        import numpy as np

        with h5py.File(out / "beam.h5", "w") as file:
            for k in range(8):
                file.create_dataset(f"field_{k}", data=np.random.default_rng(k).random(1 << 17))
                file.flush()
        return {}

    def torch_weights(out: Path, scratch: Path) -> dict[str, float]:
        import torch

        torch.save(torch.zeros(8 << 18), out / "weights.pt")
        return {}

    for build in (plain, hdf5, torch_weights):
        with pytest.raises(DataError, match="No space left on device; free some space"):
            store.obtain("stage", build.__name__, build, dict)
        assert not [path for path in small_disk.rglob("*") if path.is_file() and path.stat().st_size]
    assert store.obtain("stage", "small", lambda out, scratch: {}, dict).path.is_dir()
