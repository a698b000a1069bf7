"""Stage `twin`: a video (or a clip of the virtual lab) with the hidden fields of a closed-loop twin drawn over it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines import footage, weights
from pipelines.kinds import Watched, kind_of
from pipelines.stages import Stage


def inputs(config: DictConfig) -> tuple[str, ...]:
    """A clip where no video is named, and the trainings whose weights are used."""
    clips = ("film",) if config.twin.video is None else ()
    return (*clips, *weights.inputs_of(config.twin.weights))


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes `twin.webm`, `twin.rrd`, pictures and tables, prints the latency; returns the figures."""
    kind = kind_of(cfg.scene, cfg.twin)
    clip = footage.clip_of(cfg.twin, inputs, kind)
    source = footage.source_of(cfg, clip)
    scene, camera = footage.told(cfg, clip, source, kind)
    parts = weights.twin_weights(cfg.twin.weights, inputs, kind)
    return kind.watch(cfg, parts, Watched(clip, source, scene, camera), out)


STAGE = Stage(
    "twin",
    2,
    ("scene", "twin", "budget"),
    run,
    inputs,
    applies=footage.applies,
    sources=footage.sources,
    narrow=footage.narrow,
)
