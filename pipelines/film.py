"""Stage `film`: clips of the virtual laboratory, each a video with what the twin is told and the hidden truth."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines.stages import Stage

SIZES = ("sizes", "beyond_sizes", "train", "val", "test", "beyond", "held_out", "seed")  # what draws them


def applies(config: DictConfig) -> bool:
    """Whether the experiment has a virtual laboratory (group `lab`)."""
    return config.lab is not None


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes a set of clips (see `zsdt.lab.clips.ClipSet`); a run that was killed keeps what it has.

    Sizes of beams that the experiment trains on are left out, so that no twin has met what it sees.
    """
    from zsdt.lab.beam_lab import trained_sizes
    from zsdt.lab.clips import make_clips
    from zsdt.solid.sampler import SynthesisOptions

    options = cfg.lab
    if isinstance(cfg.data, SynthesisOptions):
        options = replace(options, exclude_cm=[*options.exclude_cm, *trained_sizes(cfg.data)])
    figures = make_clips(options, scratch / "clips", workers=cfg.machine.workers)
    for path in (scratch / "clips").iterdir():
        os.replace(path, out / path.name)
    return figures


def narrow(read: dict[str, Any]) -> dict[str, Any]:
    """Of the data only what says which sizes are trained on."""
    data = read["data"]
    return {"lab": read["lab"], "data": {k: data[k] for k in SIZES if k in data}}


STAGE = Stage("film", 1, ("lab", "data"), run, applies=applies, narrow=narrow)
