"""Stages `synthesize` and `synthesize_shard`: our own beams and glasses, simulated in one piece or in several."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig, OmegaConf

import zsdt.fluid.dataset
import zsdt.solid.dataset
from pipelines.stages import PIECE, Stage
from pipelines.store import MANIFEST
from zsdt.fluid.sampler import LiquidSynthesisOptions
from zsdt.solid.sampler import SynthesisOptions
from zsdt.workers import Shard, take_pieces

# Who simulates what: the options of an experiment's data say which of the two ground truths makes them.
GENERATORS: dict[type, Callable[..., dict[str, Any]]] = {
    SynthesisOptions: zsdt.solid.dataset.generate,
    LiquidSynthesisOptions: zsdt.fluid.dataset.generate,
}


def applies(config: DictConfig) -> bool:
    """Whether the data of this experiment are simulated."""
    return OmegaConf.get_type(config.data) in GENERATORS


def pieces(config: DictConfig) -> dict[str, DictConfig]:
    """Configs of the pieces in which the data are made: none where they are made in one."""
    count = config.machine.shards
    found = {}
    for number in range(1, count + 1) if count > 1 else ():
        found[f"{number}/{count}"] = config.copy()
        found[f"{number}/{count}"].shard = f"{number}/{count}"
    return found


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes a data set folder (see `zsdt.trajectory.Dataset`), from pieces where there are some; a run that was
    killed keeps what it has."""
    parts = [folder for role, folder in sorted(inputs.items()) if role.startswith(PIECE)]
    take_pieces(parts, scratch / "set")
    figures = GENERATORS[type(cfg.data)](cfg.data, scratch / "set", workers=cfg.machine.workers)
    for part in parts:
        theirs = json.loads((part / MANIFEST).read_text())["figures"]
        figures["cpu_s"] += theirs["cpu_s"]
        figures["peak_worker_mb"] = max(figures["peak_worker_mb"], theirs["peak_worker_mb"])
    _move(scratch / "set", out)
    return figures


def run_shard(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes the piece of a data set that `shard` names, as a data set folder of its own."""
    shard = Shard.parse(cfg.shard)
    figures = GENERATORS[type(cfg.data)](cfg.data, scratch / "set", workers=cfg.machine.workers, shard=shard)
    _move(scratch / "set", out)
    return figures


def _move(source: Path, target: Path) -> None:
    for path in source.iterdir():
        os.replace(path, target / path.name)


VERSION = 2
SHARD = Stage("synthesize_shard", VERSION, ("data", "shard"), run_shard, applies=applies)
STAGE = Stage(
    "synthesize", VERSION, ("data",), run, provides="dataset", applies=applies, made_of=SHARD.name, pieces=pieces
)
