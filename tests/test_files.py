"""Nobody sees half a file: not after an error, not on a full disk."""

import os
import shutil
import subprocess

import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.files import atomic_path, data_root
from zsdt.graph import brick_grid
from zsdt.trajectory import Body, Trajectory, write_trajectory


def test_a_file_appears_complete_and_replaces_the_old_one(tmp_path):
    target = tmp_path / "a" / "b.txt"
    for text in ("old", "new"):
        with atomic_path(target) as beside:
            assert beside.parent == target.parent
            beside.write_text(text)
            assert not target.exists() or target.read_text() == "old"
        assert target.read_text() == text
    assert os.listdir(target.parent) == ["b.txt"]


def test_a_failure_keeps_the_old_file_and_leaves_nothing_behind(tmp_path):
    target = tmp_path / "kept.txt"
    target.write_text("old")
    with pytest.raises(ValueError, match="in the middle"), atomic_path(target) as beside:
        beside.write_text("half of the n")
        raise ValueError("in the middle")
    assert target.read_text() == "old" and os.listdir(tmp_path) == ["kept.txt"]


def test_a_folder_is_moved_into_place_whole_and_cleared_away_after_a_failure(tmp_path):
    with atomic_path(tmp_path / "whole") as beside:
        (beside / "inner").mkdir(parents=True)
        (beside / "inner" / "x").write_text("x")
    assert (tmp_path / "whole" / "inner" / "x").read_text() == "x"
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "broken") as beside:
        beside.mkdir()
        (beside / "x").write_text("x")
        raise RuntimeError
    assert os.listdir(tmp_path) == ["whole"]


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 256 kB."""
    mount = shutil.which("mount")
    folder = tmp_path / "small"
    folder.mkdir()
    if mount is None or os.geteuid() != 0:
        pytest.skip("a small file system can be mounted by root only")
    made = subprocess.run([mount, "-t", "tmpfs", "-o", "size=256k", "tmpfs", folder], capture_output=True, check=False)
    if made.returncode != 0:
        pytest.skip("this machine does not let a test mount a file system")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_full_disk_gives_one_sentence_and_no_leftovers(small_disk):
    grid = brick_grid((4, 4, 4), 0.05)
    count = len(grid.points)
    body = Body(grid.points, grid.pairs, np.zeros(count, bool), np.ones(count), 0.1, 0.05)
    noise = np.random.default_rng(0).normal(size=(200, count, 3))
    big = Trajectory(body, np.arange(200.0), {"position": noise, "velocity": noise}, noise)
    for write in (lambda: write_trajectory(small_disk / "t.h5", big), lambda: write_text(small_disk / "t.txt")):
        with pytest.raises(DataError, match=r"Could not write.*Free some space") as caught:
            write()
        assert "\n" not in str(caught.value)
        assert os.listdir(small_disk) == []


def write_text(path):
    with atomic_path(path) as beside:
        beside.write_text("x" * 400_000)


def test_data_folder_can_be_named(monkeypatch, tmp_path):
    monkeypatch.setenv("ZSDT_DATA", str(tmp_path))
    assert data_root() == tmp_path
    monkeypatch.delenv("ZSDT_DATA")
    assert data_root().parts[-2:] == ("shared", "data")
