"""Stage `film`: clips of the virtual laboratory, each a video with what the twin is told and the hidden truth."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines.kinds import kind_of
from pipelines.stages import Stage

SIZES = ("sizes", "beyond_sizes", "train", "val", "test", "beyond", "held_out", "seed")  # what draws those of beams


def applies(config: DictConfig) -> bool:
    """Whether the experiment has a virtual laboratory (group `lab`)."""
    return config.lab is not None


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes a set of clips (`zsdt.lab.clips`, `zsdt.lab.glass_clips`); a run that was killed keeps what it has."""
    figures = kind_of(cfg.lab).film(cfg, scratch / "clips")
    for path in (scratch / "clips").iterdir():
        os.replace(path, out / path.name)
    return figures


def narrow(read: dict[str, Any]) -> dict[str, Any]:
    """Of the data only what says which sizes of beams are trained on."""
    data = read["data"] if "sizes" in read["data"] else {}
    return {"lab": read["lab"], "data": {k: data[k] for k in SIZES if k in data}}


STAGE = Stage("film", 1, ("lab", "data"), run, applies=applies, narrow=narrow)
