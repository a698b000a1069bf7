"""Stage `characterise`: the material of a painted beam from a video in which it rests, is plucked, and swings free."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines import footage, weights
from pipelines.kinds import kind_of
from pipelines.stages import Stage
from zsdt.errors import OptionError
from zsdt.files import atomic_path
from zsdt.twin.twin_scene import BeamTwinScene


def inputs(config: DictConfig) -> tuple[str, ...]:
    """A clip where no video is named, and the training of the segmentation where it is not the shipped one."""
    clips = ("film",) if config.twin.video is None else ()
    return (*clips, *(name for name in weights.inputs_of(config.twin.weights) if name == "train_vision"))


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes `material.json`; prints the card as overrides of a scene. Density is taken as told."""
    from zsdt.perception.segmentation import load_segmenter
    from zsdt.twin.video_material import material_from_video

    if not isinstance(cfg.scene, BeamTwinScene):
        raise OptionError("Only the material of a beam is found from a video; choose scene=foam_beam.")
    kind = kind_of(cfg.scene, cfg.twin)
    clip = footage.clip_of(cfg.twin, inputs, kind)
    source = footage.source_of(cfg, clip)
    scene, camera = footage.told(cfg, clip, source, kind)
    segmenter = load_segmenter(weights.vision_of(cfg.twin.weights, inputs, kind), cfg.twin.backend)
    found = material_from_video(source, segmenter, camera, scene)
    summary = {**found.summary(), "notes": found.notes}
    with atomic_path(out / "material.json") as beside:
        beside.write_text(json.dumps(summary, indent=1))
    card = found.material
    print(
        f"scene.material.young={card.young:.4g} scene.material.g1={card.g1:.3g} scene.material.tau={card.tau:.3g} "
        f"scene.material.density={card.density:.4g}   (swing {found.frequency:.3g} Hz, damping {found.damping:.3g})"
    )
    return found.summary()


STAGE = Stage(
    "characterise",
    1,
    ("scene", "twin"),
    run,
    inputs,
    applies=lambda config: footage.applies(config) and "characterise" in config.stages,
    sources=footage.sources,
    narrow=footage.narrow,
)
