"""Stage `train_vision`: segmentation, from pictures of the virtual lab, a user's own, or both."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines.kinds import kind_of
from pipelines.stages import Stage
from zsdt.errors import DataError


def applies(config: DictConfig) -> bool:
    """Whether the experiment has a segmentation (group `vision`)."""
    return config.vision is not None


def sources(cfg: SimpleNamespace) -> list[Path]:
    """Pictures, masks and weights of a user's own.

    Raises: DataError where a named folder is missing.
    """
    found: list[Path] = []
    for name in (cfg.vision.folder, getattr(cfg.vision, "start", None)):
        if name is not None:
            if not Path(name).is_dir():
                raise DataError(f"There is no folder {name}; correct vision.folder or vision.start.")
            found += sorted(path for path in Path(name).rglob("*") if path.is_file())
    return found


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Trains; then judges on pictures of the lab whose looks were never trained on."""
    return kind_of(cfg.vision).train_vision(cfg, out, scratch)


STAGE = Stage("train_vision", 1, ("vision", "vision_judge"), run, applies=applies, sources=sources)
