"""Stage `twin`: a video (or a clip of the virtual lab) with the hidden fields of a closed-loop twin drawn over it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
from omegaconf import DictConfig, OmegaConf

from pipelines import footage, weights
from pipelines.options import FirstStress
from pipelines.stages import Stage
from zsdt.errors import OptionError
from zsdt.perception.camera import Camera
from zsdt.perception.video import FrameSource, WebcamSource
from zsdt.twin.loop import LoopMode
from zsdt.twin.twin_scene import BeamTwinScene

BEAM_FIELDS = ("velocity", "stress")  # what overlay and recording are made of


def inputs(config: DictConfig) -> tuple[str, ...]:
    """A clip where no video is named, and the trainings whose weights are used."""
    clips = ("film",) if config.twin.video is None else ()
    return (*clips, *weights.inputs_of(config.twin.weights))


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes `twin.webm`, `twin.rrd`, pictures and tables, prints the latency; returns the figures."""
    from zsdt.twin.log_view import view_of
    from zsdt.twin.show import KeptFrames, Sides, keep_run, latency_frame

    clip = footage.clip_of(cfg.twin, inputs)
    source = footage.source_of(cfg, clip)
    scene, camera = footage.told(cfg, clip, source)
    scene = replace(scene, fields=list(dict.fromkeys([*scene.fields, *BEAM_FIELDS])))
    live = isinstance(source, WebcamSource)
    if live and not cfg.twin.loop.frames:
        raise OptionError("A webcam never ends; say how many frames you want, such as twin.loop.frames=300.")
    kept = KeptFrames(source.fps, source.name) if live else None
    log = _run(cfg, inputs, source, scene, camera, cfg.twin.loop, kept)
    origin = "virtual lab" if clip is not None else source.name
    sides = Sides(view_of(log, origin))
    if not live and cfg.twin.compare_open and cfg.twin.loop.mode is LoopMode.closed:
        options = replace(cfg.twin.loop, mode=LoopMode.open, frames=log.count, realtime=False)
        sides.open_loop = view_of(_run(cfg, inputs, source, scene, camera, options, None), origin)
    if clip is not None:
        sides.truth = _truth(clip, sides)
    text = OmegaConf.to_yaml(OmegaConf.structured({"scene": scene, "twin": cfg.twin}))
    keep_run(out, log, sides, kept or source, cfg.twin.overlay, cfg.twin.recording, text, print)
    print(latency_frame(log).round(2).to_string(index=False))
    print(f"{log.count} frames, faults: {log.faults() or 'none'}; look at twin.webm, twin.rrd and summary.png")
    return _figures(log, sides)


def _run(
    cfg: SimpleNamespace, inputs: dict[str, Path], source: FrameSource, scene: BeamTwinScene, camera: Camera,
    options: Any, sink: Any,
) -> Any:  # fmt: skip
    from zsdt.perception.depth import open_depth_maps
    from zsdt.perception.segmentation import load_segmenter
    from zsdt.tignn.engine import load_engine
    from zsdt.tignn.psi_ini import load
    from zsdt.twin.loop import run_twin

    cv2.setNumThreads(cfg.machine.threads)
    parts = weights.twin_weights(cfg.twin.weights, inputs)
    psi_ini = None
    if cfg.twin.first_stress is FirstStress.psi_ini and parts.psi_ini is not None:
        psi_ini = load(parts.psi_ini)
    return run_twin(
        source, load_segmenter(parts.vision, cfg.twin.backend), scene, options, camera=camera,
        engine=load_engine(parts.tignn), psi_ini=psi_ini,
        depth_maps=open_depth_maps(scene.depth_maps), sink=sink,
    )  # fmt: skip


def _truth(clip: Any, sides: Any) -> Any:
    from zsdt.lab.beam_lab import node_grid
    from zsdt.twin.twin_view import truth_view

    near = node_grid(clip.truth.body, clip.clamp_side)["near"]
    return truth_view(clip.truth, sides.twin, clip.true_camera, near)


def _figures(log: Any, sides: Any) -> dict[str, Any]:
    from zsdt.evaluation.beam_twin_cases import errors_of

    figures: dict[str, Any] = {"frames": log.count, "nodes": log.body.nodes, "stiffness": log.stiffness}
    figures["latency"] = {part: {k: row[k] for k in ("p50", "p99")} for part, row in log.latency_table().items()}
    for name, view in ((log.mode, sides.twin), ("open", sides.open_loop)):
        if view is not None and sides.truth is not None:
            figures[name] = errors_of(view, sides.truth)
    return figures


STAGE = Stage(
    "twin",
    1,
    ("scene", "twin"),
    run,
    inputs,
    applies=footage.applies,
    sources=footage.sources,
    narrow=footage.narrow,
)
