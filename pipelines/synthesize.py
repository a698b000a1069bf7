"""Stage `synthesize`: our own beams, simulated."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pipelines.stages import Stage
from zsdt.solid.dataset import SynthesisOptions, generate


def applies(config: DictConfig) -> bool:
    """Whether the data of this experiment are simulated."""
    return OmegaConf.get_type(config.data) is SynthesisOptions


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes a data set folder (see `zsdt.trajectory.Dataset`); a run that was killed keeps the beams that it has."""
    figures = generate(cfg.data, scratch / "set", workers=cfg.machine.workers)
    for path in (scratch / "set").iterdir():
        os.replace(path, out / path.name)
    return figures


STAGE = Stage("synthesize", 2, ("data",), run, provides="dataset", applies=applies)
