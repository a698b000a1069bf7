"""The liquid in a glass: which rooms stand behind the stages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from omegaconf import OmegaConf

from pipelines.kinds import Kind, Watched
from pipelines.options import GlassTwinRun
from zsdt.errors import OptionError
from zsdt.evaluation.glass_twin_cases import GlassTwinEvaluationOptions
from zsdt.lab.glass_clips import GlassClip, GlassClipSet
from zsdt.lab.glass_lab import GlassLabOptions
from zsdt.perception.camera import Camera
from zsdt.perception.glass_vision_train import GlassVisionOptions
from zsdt.perception.video import WebcamSource
from zsdt.perception.yolo_glass import YoloOptions
from zsdt.shipped import TwinWeights
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.loop_common import LoopMode

FIELDS = ("velocity", "internal_energy")  # what overlay and recording are made of


def film(cfg: SimpleNamespace, folder: Path) -> dict[str, Any]:
    """Clips of glasses that were carried and stopped."""
    from zsdt.lab.glass_clips import make_glass_clips

    return make_glass_clips(cfg.lab, folder, workers=cfg.machine.workers)


def told(scene: GlassTwinScene, clip: GlassClip) -> GlassTwinScene:
    """What the lab tells the twin of a clip."""
    card = clip.scene
    return replace(
        scene,
        liquid=card.liquid,
        wall=card.wall,
        floor=card.floor,
        glass_index=card.glass_index,
        liquid_index=card.liquid_index,
        section=None if card.section is None else list(card.section),
        gravity=card.gravity,
        fps=card.fps,
    )


def placed(camera: Camera, twin: GlassTwinRun) -> Camera:
    """A camera that knows only its lens, put where the options say that it stands; others as they are."""
    if camera.translation.any():
        return camera
    tilt = np.radians(twin.tilt_deg)
    sin, cos = float(np.sin(tilt)), float(np.cos(tilt))
    axes = np.array([[1.0, 0.0, 0.0], [0.0, -sin, -cos], [0.0, cos, -sin]])
    return replace(camera, rotation=axes, translation=-axes @ np.array([0.0, -twin.distance, twin.height]))


def train_vision(cfg: SimpleNamespace, out: Path, scratch: Path) -> dict[str, Any]:
    """Trains on painted, ray-traced and a user's own pictures; then judges on looks that were never trained on."""
    from zsdt.evaluation.glass_vision_training import train_and_judge

    return train_and_judge(cfg.vision, cfg.vision_judge, out, scratch)


def watch(cfg: SimpleNamespace, parts: TwinWeights, watched: Watched, out: Path) -> dict[str, Any]:
    """A glass twin in front of a video; open loop and truth beside it where there are."""
    from zsdt.twin.glass_log_view import glass_view_of
    from zsdt.twin.glass_show import GlassSides, glass_latency_frame, keep_glass_run
    from zsdt.twin.glass_view import glass_truth_view
    from zsdt.twin.show import KeptFrames

    source, clip = watched.source, watched.clip
    live = isinstance(source, WebcamSource)
    plan = None
    if cfg.twin.plan:
        plan = _planned(cfg, watched)
        cfg, watched = as_planned(cfg, plan), replace(watched, scene=plan.scene)
    else:
        watched = replace(watched, scene=replace(watched.scene, fields=_with(watched.scene.fields)))
    if live and not cfg.twin.loop.frames:
        raise OptionError("A webcam never ends; say how many frames you want, such as twin.loop.frames=300.")
    kept = KeptFrames(source.fps, source.name) if live else None
    log = _run(cfg, parts, watched, cfg.twin.loop, kept, plan)
    origin = "virtual lab" if clip is not None else source.name
    sides = GlassSides(glass_view_of(log, origin))
    if not live and cfg.twin.compare_open and cfg.twin.loop.mode is LoopMode.closed:
        options = replace(cfg.twin.loop, mode=LoopMode.open, frames=log.count, realtime=False)
        sides.open_loop = glass_view_of(_run(cfg, parts, watched, options, None), origin)
    if clip is not None:
        sides.truth = glass_truth_view(clip.truth, clip.pose, clip.true_camera, sides.twin)
    text = OmegaConf.to_yaml(OmegaConf.structured({"scene": watched.scene, "twin": cfg.twin}))
    keep_glass_run(out, log, sides, kept or source, cfg.twin.overlay, cfg.twin.recording, text, print)
    print(glass_latency_frame(log).round(2).to_string(index=False))
    print(f"{log.count} frames, faults: {log.faults() or 'none'}; look at twin.webm, twin.rrd and summary.png")
    figures = _figures(log, sides)
    return figures if plan is None else figures | {"plan": plan.figures()}


def _planned(cfg: SimpleNamespace, watched: Watched) -> Any:
    """What the budget asks for."""
    from zsdt.planning.planner import plan_glass

    plan = plan_glass(watched.scene, cfg.budget)
    print(f"plan: {plan.words}")
    return plan


def as_planned(cfg: SimpleNamespace, plan: Any) -> SimpleNamespace:
    """The options of a run with a plan put in: cadence, the fastest segmentation, one run alone, and the first wanted
    field as the overlay."""
    from zsdt.planning.choices import with_cadence
    from zsdt.planning.planner import backend
    from zsdt.twin.field_scale import LiquidName

    energy = plan.scene.fields[0] == "internal_energy"
    overlay = replace(cfg.twin.overlay, field=LiquidName.internal_energy if energy else LiquidName.vertical_velocity)
    loop = with_cadence(cfg.twin.loop, plan.choice)
    twin = replace(cfg.twin, compare_open=False, loop=loop, overlay=overlay, backend=backend())
    return SimpleNamespace(**{**vars(cfg), "twin": twin})


def _with(fields: list[str]) -> list[str]:
    return list(dict.fromkeys([*fields, *FIELDS]))


def _run(cfg: SimpleNamespace, parts: TwinWeights, watched: Watched, options: Any, sink: Any, plan: Any = None) -> Any:
    from zsdt.evaluation.glass_twin_cases import load_glass_engine
    from zsdt.perception.glass_segmentation import load_glass_segmenter
    from zsdt.tignn.psi_ini_liquid import load
    from zsdt.twin.glass_loop import run_glass_twin

    cv2.setNumThreads(cfg.machine.threads)
    engine = load_glass_engine(parts.tignn)
    return run_glass_twin(
        watched.source, load_glass_segmenter(parts.vision, cfg.twin.backend), watched.scene, options,
        camera=watched.camera, engine=engine if plan is None else plan.choice.engine(engine),
        psi_ini=None if parts.psi_ini is None else load(parts.psi_ini), sink=sink,
    )  # fmt: skip


def _figures(log: Any, sides: Any) -> dict[str, Any]:
    from zsdt.evaluation.glass_twin_cases import glass_errors

    figures: dict[str, Any] = {"frames": log.count, "nodes": log.body.nodes, "t0_frame": int(log.frames[log.start])}
    figures["latency"] = {part: {k: row[k] for k in ("p50", "p99")} for part, row in log.latency_table().items()}
    if log.trust is not None:
        figures["trust"] = log.trust.figures()
    for name, view in ((log.mode, sides.twin), ("open", sides.open_loop)):
        if view is not None and sides.truth is not None:
            figures[name] = glass_errors(view, sides.truth)
    return figures


def evaluate(clips: Path, parts: TwinWeights, options: Any, out: Path, scratch: Path, workers: int) -> dict[str, Any]:
    """Tables and a picture (see `zsdt.evaluation.glass_twin_report`)."""
    from zsdt.evaluation.glass_twin_report import evaluate_glass_clips

    return evaluate_glass_clips(clips, parts, options, out, scratch, workers)


GLASS = Kind(
    name="glass",
    weights="glycerin_glass",
    lab=GlassLabOptions,
    vision=(GlassVisionOptions, YoloOptions),
    scene=GlassTwinScene,
    twin=GlassTwinRun,
    evaluation=GlassTwinEvaluationOptions,
    film=film,
    clips=GlassClipSet,
    told=told,
    placed=placed,
    train_vision=train_vision,
    watch=watch,
    evaluate=evaluate,
)
