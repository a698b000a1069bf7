"""Which recording `make view` opens."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pipelines.view import main, newest_recording


def test_the_newest_evaluation_counts_and_the_engine_comes_before_its_rivals(tmp_path: Path) -> None:
    for age, (key, method) in enumerate([("new", "black_box"), ("new", "tignn_cell"), ("old", "tignn_cell")]):
        path = tmp_path / "artifacts" / "evaluate" / key / "recordings" / method / "test_000.rrd"
        path.parent.mkdir(parents=True)
        path.write_bytes(b"RRF2")
        os.utime(path, (1e9 - age, 1e9 - age))
    assert newest_recording(tmp_path).parts[-4:] == ("new", "recordings", "tignn_cell", "test_000.rrd")


def test_the_recording_of_a_twin_counts_but_not_one_in_the_making(tmp_path: Path) -> None:
    old = tmp_path / "artifacts" / "evaluate" / "old" / "recordings" / "tignn_cell" / "test_000.rrd"
    twin, unfinished = (tmp_path / "artifacts" / "twin" / key / "twin.rrd" for key in ("new", ".newer.part"))
    for age, path in enumerate([unfinished, twin, old]):
        path.parent.mkdir(parents=True)
        path.write_bytes(b"RRF2")
        os.utime(path, (1e9 - age, 1e9 - age))
    assert newest_recording(tmp_path) == twin


def test_no_recording_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--outputs", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith("error: There is no recording below")
    assert main(["--file", str(tmp_path / "none.rrd")]) == 1
    assert "There is no recording" in capsys.readouterr().err
