"""Data in pieces: every piece an artifact of its own, and a whole whose key does not know of them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from omegaconf import DictConfig

from pipelines.jobs import run_job
from pipelines.registry import APPLICATION

TINY = (
    "experiment=beam_ci",
    "stages=[synthesize]",
    "data.train=1",
    "data.val=0",
    "data.test=1",
    "data.beyond=0",
    "data.sizes.length_cm=[35,40]",
    "data.sizes.width_cm=[10,10]",
    "data.sizes.depth_cm=[10,10]",
    "data.hand_duration=0.05",
    "data.dynamic_duration=0.03",
    "data.mesh=0.05",
    "machine.workers=1",
)


def config_of(*overrides: str) -> DictConfig:
    return APPLICATION.compose([*TINY, *overrides])


def job(outputs: Path, name: str, *overrides: str) -> dict:
    config = config_of(f"machine.outputs={outputs}", *overrides)
    return run_job(config, APPLICATION.planner(), outputs / name, overrides)["stages"]


def data_of(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_keys_know_which_piece_and_the_whole_does_not_know_of_pieces() -> None:
    plan = APPLICATION.planner().plan
    (whole,) = plan(config_of())
    *pieces, merged = plan(config_of("machine.shards=3"))
    assert merged.key == whole.key and not whole.pieces
    assert len({piece.key for piece in pieces}) == 3
    (second,) = plan(config_of("stages=[synthesize_shard]", "shard=2/3"))
    assert second.key == pieces[1].key
    (other,) = plan(config_of("stages=[synthesize_shard]", "shard=2/3", "data.seed=9"))
    assert other.key != second.key


def test_jobs_that_make_pieces_and_one_that_puts_them_together(tmp_path: Path) -> None:
    alone = job(tmp_path / "alone", "job")["synthesize"]
    shared = tmp_path / "shared"
    job(shared, "piece", "stages=[synthesize_shard]", "shard=2/2")
    stages = job(shared, "whole", "machine.shards=2")
    assert stages["synthesize_shard.2/2"]["reused"] and not stages["synthesize_shard.1/2"]["reused"]
    assert stages["synthesize"]["key"] == alone["key"]
    folders = [root / "artifacts" / "synthesize" / alone["key"] for root in (tmp_path / "alone", shared)]
    assert data_of(folders[0]) == data_of(folders[1])
    manifests = [json.loads((folder / "manifest.json").read_text()) for folder in folders]
    assert sorted(manifests[1]["inputs"]) == ["piece.1/2", "piece.2/2"]
    assert manifests[1]["figures"]["cpu_s"] > 0, "what the pieces took is counted"
    shutil.rmtree(shared / "artifacts" / "synthesize_shard")
    assert list(job(shared, "again", "machine.shards=2")) == ["synthesize"], (
        "no piece is made for a whole that is there"
    )
