"""Stage `synthesize`: our own beams and glasses, simulated."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig, OmegaConf

import zsdt.fluid.dataset
import zsdt.solid.dataset
from pipelines.stages import Stage
from zsdt.fluid.sampler import LiquidSynthesisOptions
from zsdt.solid.sampler import SynthesisOptions

# Who simulates what: the options of an experiment's data say which of the two ground truths makes them.
GENERATORS: dict[type, Callable[..., dict[str, Any]]] = {
    SynthesisOptions: zsdt.solid.dataset.generate,
    LiquidSynthesisOptions: zsdt.fluid.dataset.generate,
}


def applies(config: DictConfig) -> bool:
    """Whether the data of this experiment are simulated."""
    return OmegaConf.get_type(config.data) in GENERATORS


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes a data set folder (see `zsdt.trajectory.Dataset`); a run that was killed keeps what it has."""
    figures = GENERATORS[type(cfg.data)](cfg.data, scratch / "set", workers=cfg.machine.workers)
    for path in (scratch / "set").iterdir():
        os.replace(path, out / path.name)
    return figures


STAGE = Stage("synthesize", 2, ("data",), run, provides="dataset", applies=applies)
