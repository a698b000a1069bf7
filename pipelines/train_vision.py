"""Stage `train_vision`: segmentation of the painted grid, from painted pictures, a user's own, or both."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig
from tqdm import tqdm

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
    for name in (cfg.vision.folder, cfg.vision.start):
        if name is not None:
            if not Path(name).is_dir():
                raise DataError(f"There is no folder {name}; correct vision.folder or vision.start.")
            found += sorted(path for path in Path(name).rglob("*") if path.is_file())
    return found


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Trains; then judges on painted pictures of styles that were never trained on."""
    from zsdt.evaluation.vision_report import judge_vision
    from zsdt.lab.stills import painted_still
    from zsdt.lab.styles import Pool
    from zsdt.perception.segmentation import load_segmenter
    from zsdt.perception.vision_data import LabelledImages, read_folder
    from zsdt.perception.vision_train import train_segmenter

    options = cfg.vision
    seeds = tqdm(range(options.images), desc="paint", unit="picture", disable=None)
    stills = [painted_still(options.seed + seed, Pool.train) for seed in seeds]
    data = LabelledImages(
        [s.image for s in stills], [s.grid_mask for s in stills], [f"painted {k}" for k in range(len(stills))]
    )
    if options.folder is not None:
        own = read_folder(options.folder, options.category)
        data = LabelledImages([*data.images, *own.images], [*data.masks, *own.masks], [*data.names, *own.names])
    card = train_segmenter(data, options, out)
    unseen = [painted_still(seed, Pool.unseen) for seed in range(cfg.vision_judge)]
    judged = judge_vision(load_segmenter(out), unseen, out / "judged").summary if unseen else {}
    return {**{k: v for k, v in card.items() if k != "options"}, "unseen": judged}


STAGE = Stage("train_vision", 1, ("vision", "vision_judge"), run, applies=applies, sources=sources)
