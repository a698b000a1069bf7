"""Stage `train_psi_ini`: the network that infers what no camera sees at the first frame (DESIGN 4.3)."""

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
    """Trains on the data set: first stress of a solid, first velocity and internal energy of a liquid."""
    from zsdt.tignn import psi_ini, psi_ini_liquid

    train = psi_ini.train if isinstance(cfg.psi_ini, psi_ini.PsiIniOptions) else psi_ini_liquid.train
    return train(inputs["dataset"], cfg.psi_ini, out, scratch)


STAGE = Stage("train_psi_ini", 1, ("psi_ini",), run, inputs=("dataset",), applies=applies)
