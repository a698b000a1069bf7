"""Stage `evaluate_twin`: the twin on all clips of the virtual lab, in open and closed loop and under faults."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines import weights
from pipelines.kinds import kind_of
from pipelines.stages import Stage


def applies(config: DictConfig) -> bool:
    """Whether the experiment has a virtual laboratory."""
    return config.lab is not None


def sources(cfg: SimpleNamespace) -> list[Path]:
    """The shipped weights, where they are used."""
    return weights.files_of(cfg.twin_weights, kind_of(cfg.twin_evaluation, cfg.lab))


def narrow(read: dict[str, Any]) -> dict[str, Any]:
    """The lab is in the key of the clips."""
    return {name: part for name, part in read.items() if name != "lab"}


def inputs(config: DictConfig) -> tuple[str, ...]:
    """The clips, and the trainings whose weights are used."""
    return ("film", *weights.inputs_of(config.twin_weights))


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes tables and a picture (see `zsdt.evaluation`)."""
    kind = kind_of(cfg.twin_evaluation, cfg.lab)
    parts = weights.twin_weights(cfg.twin_weights, inputs, kind)
    return kind.evaluate(inputs["film"], parts, cfg.twin_evaluation, out, scratch, cfg.machine.workers)


STAGE = Stage(
    "evaluate_twin",
    2,
    ("lab", "twin_evaluation", "twin_weights"),
    run,
    inputs,
    applies=applies,
    sources=sources,
    narrow=narrow,
)
