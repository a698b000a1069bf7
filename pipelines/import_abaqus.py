"""Stage `import_abaqus`: beams that somebody else made with Abaqus, as a data set of this program."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pipelines.stages import Stage
from zsdt.interop.abaqus_beams import AbaqusOptions, convert, source_files


def applies(config: DictConfig) -> bool:
    """Whether the data of this experiment are Abaqus beams."""
    return OmegaConf.get_type(config.data) is AbaqusOptions


def sources(cfg: SimpleNamespace) -> list[Path]:
    """The files that are read; their contents are part of the key, their place is not."""
    return source_files(cfg.data)


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes a data set folder (see `zsdt.trajectory.Dataset`)."""
    return convert(cfg.data, out)


STAGE = Stage(
    "import_abaqus",
    1,
    ("data",),
    run,
    provides="dataset",
    applies=applies,
    ignores=("data.path",),
    sources=sources,
)
