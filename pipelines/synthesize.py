"""Stage `synthesize`: our own beams, simulated."""

from __future__ import annotations

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
    """Writes a data set folder (see `zsdt.trajectory.Dataset`)."""
    return generate(cfg.data, out, workers=cfg.machine.workers)


STAGE = Stage("synthesize", 1, ("data",), run, provides="dataset", applies=applies)
