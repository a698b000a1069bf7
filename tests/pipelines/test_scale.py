"""What is said about scale: comparisons that find every difference, and a reckoning that can be done by hand."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers import APP, builds, environment

from pipelines.compare import compare_stores
from pipelines.gather import read_jobs
from pipelines.scale_cost import Piece, parts_below, pieces_of
from zsdt.errors import DataError

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "slurm" / "sweep.sh"


def store(root: Path, *, seconds: float = 1.0, error: float = 0.5, weights: str = "weights.pt") -> Path:
    """One artifact: numbers, a table, weights, a picture, a manifest."""
    folder = root / "train" / "abc"
    folder.mkdir(parents=True)
    (folder / "numbers.h5").write_bytes(b"numbers")
    (folder / "table.csv").write_text(f"step,error,cpu_seconds,time_s\n1,{error},{seconds},0.1\n")
    torch.save({"w": torch.arange(3.0)}, folder / weights)  # the archive holds the name that it was written under
    os.replace(folder / weights, folder / "weights.pt")
    (folder / "plot.png").write_bytes(os.urandom(8))
    manifest = {"stage": "train", "version": 1, "key": "abc", "config": {}, "inputs": {}, "seed": 1, "host": str(root)}
    figures = {"best": {"score": float("nan")}, "cpu_minutes": seconds, "error": error}
    (folder / "manifest.json").write_text(json.dumps(manifest | {"wall_seconds": seconds, "figures": figures}))
    return root


def test_only_times_and_pictures_may_differ(tmp_path: Path) -> None:
    one = store(tmp_path / "one")
    found = compare_stores(one, store(tmp_path / "two", seconds=2.0, weights="other_name.pt"))
    assert found.same and found.counts == {"bitwise": 2, "but for times": 2, "illustration": 1}
    assert (tmp_path / "one/train/abc/weights.pt").read_bytes() != (tmp_path / "two/train/abc/weights.pt").read_bytes()


@pytest.mark.parametrize("file", ["numbers.h5", "weights.pt", "table.csv", "manifest.json", "more.txt"])
def test_every_other_difference_is_found(tmp_path: Path, file: str) -> None:
    one, two = store(tmp_path / "one"), store(tmp_path / "two", error=0.5000001)
    (two / "train/abc/numbers.h5").write_bytes(b"numbers2")
    torch.save({"w": torch.tensor([0.0, 1.0, 2.0000002])}, two / "train/abc/weights.pt")
    (two / "train/abc/more.txt").write_text("")
    for path in one.rglob("*.*"):
        if path.name != file and path.is_file():
            (two / path.relative_to(one)).write_bytes(path.read_bytes())
    if file != "more.txt":
        (two / "train/abc/more.txt").unlink()
    found = compare_stores(one, two)
    assert not found.same and len(found.different) == 1 and file in found.different[0]


def test_nothing_compared_is_not_the_same(tmp_path: Path) -> None:
    assert not compare_stores(tmp_path / "a", tmp_path / "b").same


def a_sweep(root: Path) -> Path:
    """Four jobs: data for all (12 s of 2 workers), a rival for two each (6 s), a training for each (10 s)."""

    def artifact(name: str, seconds: float, size: int, figures: dict) -> dict:
        folder = root / "artifacts" / name
        if not folder.is_dir():
            folder.mkdir(parents=True)
            (folder / "manifest.json").write_text(json.dumps({"wall_seconds": seconds, "figures": figures}))
            (folder / "data.bin").write_bytes(bytes(size - (folder / "manifest.json").stat().st_size))
            return {"artifact": f"../../../artifacts/{name}", "reused": False, "seconds": seconds}
        return {"artifact": f"../../../artifacts/{name}", "reused": True, "seconds": 0.0}

    for number in range(4):
        folder = root / "sweep" / "part" / str(number)
        folder.mkdir(parents=True)
        stages = {
            "data": artifact("data", 12.0, 9000, {"cpu_s": 20.0}),
            "rival": artifact(f"rival_{number % 2}", 6.0, 3000, {}),
            "train": artifact(f"train_{number}", 10.0, 2000, {}),
        }
        summary = {
            "experiment": "x",
            "status": "finished",
            "overrides": [],
            "stages": stages,
            "figures": {},
            "seconds": 25.0,
        }
        (folder / "summary.json").write_text(json.dumps(summary))
    return root / "sweep"


def test_cost_is_what_all_share_once_and_the_rest_per_job(tmp_path: Path) -> None:
    (jobs,) = parts_below(a_sweep(tmp_path))
    part = pieces_of(jobs, start_s=2.0)
    folder = sum(job.folder.joinpath("summary.json").stat().st_size for job in jobs) / 4
    assert part.shared == Piece(core_s=20.0, wall_s=12.0, bytes=9000, files=2)
    assert part.own == Piece(core_s=13.0, wall_s=13.0, bytes=3500 + folder, files=4.0)
    assert part.stages == {"rival": 3.0, "train": 10.0}
    assert (part.built_s, part.took_s) == (12.0 + 4 * part.own.wall_s, 100.0), "what they built, with the data once"
    row = part.reckoning(10_000)
    assert row["core-h"] == pytest.approx((20.0 + 10_000 * 15.0) / 3600)
    assert row["core-h if nothing were shared"] == pytest.approx(10_000 * 35.0 / 3600)
    assert row["h on 64 cores"] == pytest.approx((12.0 + 157 * 15.0) / 3600), "157 rounds of 64 make 10,000"
    assert row["files"] == 2 + 40_000
    assert part.reckoning(4)["core-h"] == pytest.approx(80.0 / 3600)


def test_what_is_gone_or_unfinished_is_not_reckoned(tmp_path: Path) -> None:
    sweep = a_sweep(tmp_path)
    (tmp_path / "artifacts" / "train_2" / "manifest.json").unlink()
    with pytest.raises(DataError, match="train_2 is gone"):
        pieces_of(read_jobs(sweep), start_s=0.0)
    path = sweep / "part" / "1" / "summary.json"
    path.write_text(path.read_text().replace("finished", "failed"))
    with pytest.raises(DataError, match="has two finished jobs"):
        parts_below(sweep)


def test_the_script_for_slurm_sends_the_sweep_to_the_cluster(tmp_path: Path, slurm: Path) -> None:
    pytest.importorskip("submitit", reason="submitit is not installed.")
    outputs = tmp_path / "outputs"
    outputs.mkdir()
    variables = {"ZSDT": f"{sys.executable} {APP}", "OUTPUTS": str(outputs), "BATCH": "2"}
    variables |= {"LAUNCH": "slurm.partition=cpu mem_gb=3", "SLURM_MEM_PER_CPU": "17"}
    words = ["bash", str(SCRIPT), "small", "1", "tignn.passes=2,3,4"]
    done = subprocess.run(
        words, env=environment() | variables, capture_output=True, text=True, timeout=240, cwd=tmp_path
    )
    assert done.returncode == 0 and "3 of 3 jobs finished." in done.stdout, done.stderr
    scripts = [path.read_text() for path in sorted(slurm.glob("*.sbatch"))]
    assert ["array=0-1%2" in scripts[0], "array" in scripts[1], len(scripts)] == [True, False, 2], "batches of BATCH"
    assert all("#SBATCH --partition=cpu\n" in text and "#SBATCH --mem=3GB\n" in text for text in scripts)
    assert sum(line.startswith("train") for line in builds(outputs)) == 3
