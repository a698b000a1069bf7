"""Stage `train_psi_ini`: the network that reads the first stress off a body at rest (DESIGN 4.3)."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines.stages import Stage


def applies(config: DictConfig) -> bool:
    """Whether the experiment has such a network (``psi_ini: null`` if not)."""
    return config.psi_ini is not None


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Trains on the first frames of the data set."""
    from zsdt.tignn.psi_ini import train

    return train(inputs["dataset"], cfg.psi_ini, out, scratch)


STAGE = Stage("train_psi_ini", 1, ("psi_ini",), run, inputs=("dataset",), applies=applies)
