"""Stage `twin`: a video (or a clip of the virtual lab) with the hidden fields of a closed-loop twin drawn over it."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from omegaconf import DictConfig, OmegaConf

from pipelines import weights
from pipelines.options import TwinRun
from pipelines.stages import Stage
from zsdt.errors import DataError, OptionError
from zsdt.perception.camera import Camera, load_camera
from zsdt.perception.video import FrameSource, WebcamSource, open_video
from zsdt.twin.loop import LoopMode
from zsdt.twin.twin_scene import BeamTwinScene

BEAM_FIELDS = ("velocity", "stress")  # what overlay and recording are made of


def applies(config: DictConfig) -> bool:
    """Whether there is a scene (group `scene`)."""
    return config.scene is not None


def inputs(config: DictConfig) -> tuple[str, ...]:
    """A clip where no video is named, and the trainings whose weights are used."""
    clips = ("film",) if config.twin.video is None else ()
    return (*clips, *weights.inputs_of(config.twin.weights))


def sources(cfg: SimpleNamespace) -> list[Path]:
    """Video, camera and shipped weights.

    Raises: DataError where a named file is missing.
    """
    found = weights.files_of(cfg.twin.weights)
    for name in (cfg.twin.video, cfg.twin.camera):
        if name is None or name.isdigit():
            continue
        if not Path(name).exists():
            raise DataError(f"There is no file or folder {name}; correct twin.video or twin.camera.")
        found += sorted(p for p in Path(name).rglob("*") if p.is_file()) if Path(name).is_dir() else [Path(name)]
    return found


def narrow(read: dict[str, Any]) -> dict[str, Any]:
    """A live camera never shows the same twice, so a run of it gets the time into its key."""
    video = read["twin"]["video"]
    if video is not None and video.isdigit():
        return {**read, "taken": time.time()}
    return {**read, "twin": {k: v for k, v in read["twin"].items() if k not in ("video", "camera")}}


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes `twin.webm`, `twin.rrd`, pictures and tables, prints the latency; returns the figures."""
    from zsdt.twin.log_view import view_of
    from zsdt.twin.show import KeptFrames, Sides, keep_run, latency_frame

    clip = _clip_of(cfg.twin, inputs)
    source = clip.source() if clip is not None else open_video(str(cfg.twin.video), cfg.scene.fps or None)
    scene, camera = _told(cfg, clip, source)
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
    print(f"frames {log.count}, faults {log.faults() or 'none'}; see twin.webm, twin.rrd, summary.png in {out.name}")
    return _figures(log, sides)


def _clip_of(twin: TwinRun, inputs: dict[str, Path]) -> Any:
    from zsdt.lab.clips import ClipSet

    if twin.video is not None:
        return None
    clips = ClipSet(inputs["film"])
    if not 0 <= twin.clip < len(clips):
        raise OptionError(f"There is no clip {twin.clip}; the virtual lab has {len(clips)}, counted from 0.")
    return clips[twin.clip]


def _told(cfg: SimpleNamespace, clip: Any, source: FrameSource) -> tuple[BeamTwinScene, Camera]:
    """Scene and camera as the twin is told them: by the lab, or by the options."""
    scene = replace(cfg.scene, fields=list(dict.fromkeys([*cfg.scene.fields, *BEAM_FIELDS])))
    if clip is not None:
        told = clip.scene
        return replace(
            scene,
            width=told.beam_width,
            pitch=told.pitch,
            material=told.material,
            depth=told.depth,
            fps=told.fps,
            depth_maps=clip.depth or scene.depth_maps,
        ), clip.camera
    if cfg.twin.camera is not None:
        return scene, load_camera(cfg.twin.camera)
    if cfg.twin.focal_px is None:
        raise OptionError(
            "The camera is unknown: calibrate it (stages=[calibrate_camera] camera.images=FOLDER) and set "
            "twin.camera to the file, or give its focal length in pixels as twin.focal_px."
        )
    # Without a pose: the twin looks straight at the face, on the side that it finds.
    width, height = source.size
    focal = cfg.twin.focal_px
    matrix = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return scene, Camera(matrix, np.zeros(5), np.eye(3), np.zeros(3), width, height)


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
    return run_twin(
        source, load_segmenter(parts.vision, cfg.twin.backend), scene, options, camera=camera,
        engine=load_engine(parts.tignn), psi_ini=None if parts.psi_ini is None else load(parts.psi_ini),
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


STAGE = Stage("twin", 1, ("scene", "twin"), run, inputs, applies=applies, sources=sources, narrow=narrow)
