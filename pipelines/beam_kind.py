"""The beam: which rooms stand behind the stages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
from omegaconf import OmegaConf
from tqdm import tqdm

from pipelines.kinds import Kind, Watched
from pipelines.options import FirstStress, TwinRun
from zsdt.errors import OptionError
from zsdt.evaluation.beam_twin_cases import TwinEvaluationOptions
from zsdt.lab.beam_lab import BeamLabOptions
from zsdt.lab.clips import Clip, ClipSet
from zsdt.perception.camera import Camera
from zsdt.perception.video import WebcamSource
from zsdt.perception.vision_train import VisionOptions
from zsdt.shipped import TwinWeights
from zsdt.solid.sampler import SynthesisOptions
from zsdt.twin.loop_common import LoopMode
from zsdt.twin.twin_scene import BeamTwinScene

FIELDS = ("velocity", "stress")  # what overlay and recording are made of


def film(cfg: SimpleNamespace, folder: Path) -> dict[str, Any]:
    """Clips of beams. Sizes that the experiment trains on are left out, so that no twin has met what it sees."""
    from zsdt.lab.beam_lab import trained_sizes
    from zsdt.lab.clips import make_clips

    options = cfg.lab
    if isinstance(cfg.data, SynthesisOptions):
        options = replace(options, exclude_cm=[*options.exclude_cm, *trained_sizes(cfg.data)])
    return make_clips(options, folder, workers=cfg.machine.workers)


def told(scene: BeamTwinScene, clip: Clip) -> BeamTwinScene:
    """What the lab tells the twin of a clip."""
    card = clip.scene
    return replace(
        scene,
        width=card.beam_width,
        pitch=card.pitch,
        material=card.material,
        depth=card.depth,
        fps=card.fps,
        depth_maps=clip.depth or scene.depth_maps,
    )


def placed(camera: Camera, twin: TwinRun) -> Camera:
    """As it is: without a pose the twin looks straight at the face, on the side that it finds."""
    return camera


def train_vision(cfg: SimpleNamespace, out: Path, scratch: Path) -> dict[str, Any]:
    """Trains on painted pictures, a user's own, or both; then judges on painted styles that were never trained on."""
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


def watch(cfg: SimpleNamespace, parts: TwinWeights, watched: Watched, out: Path) -> dict[str, Any]:
    """A beam twin in front of a video; open loop and truth beside it where there are."""
    from zsdt.twin.log_view import view_of
    from zsdt.twin.show import KeptFrames, Sides, keep_run, latency_frame

    source, clip = watched.source, watched.clip
    live = isinstance(source, WebcamSource)
    plan = _planned(cfg, parts, watched, live) if cfg.twin.plan else None
    scene = replace(watched.scene, fields=list(dict.fromkeys([*watched.scene.fields, *FIELDS])))
    if plan is not None:
        cfg, parts, scene = as_planned(cfg, plan), replace(parts, psi_ini=None), plan.scene
    if live and not cfg.twin.loop.frames:
        raise OptionError("A webcam never ends; say how many frames you want, such as twin.loop.frames=300.")
    watched = replace(watched, scene=scene)
    kept = KeptFrames(source.fps, source.name) if live else None
    log = _run(cfg, parts, watched, cfg.twin.loop, kept)
    origin = "virtual lab" if clip is not None else source.name
    sides = Sides(view_of(log, origin))
    if not live and cfg.twin.compare_open and cfg.twin.loop.mode is LoopMode.closed:
        options = replace(cfg.twin.loop, mode=LoopMode.open, frames=log.count, realtime=False)
        sides.open_loop = view_of(_run(cfg, parts, watched, options, None), origin)
    if clip is not None:
        sides.truth = _truth(clip, sides, log.body)
    text = OmegaConf.to_yaml(OmegaConf.structured({"scene": scene, "twin": cfg.twin}))
    keep_run(out, log, sides, kept or source, cfg.twin.overlay, cfg.twin.recording, text, print)
    print(latency_frame(log).round(2).to_string(index=False))
    print(f"{log.count} frames, faults: {log.faults() or 'none'}; look at twin.webm, twin.rrd and summary.png")
    figures = _figures(log, sides)
    return figures if plan is None else figures | {"plan": plan.figures()}


def _planned(cfg: SimpleNamespace, parts: TwinWeights, watched: Watched, live: bool) -> Any:
    """What the budget asks for; a beam's size is seen in the first picture, if it can be shown again."""
    from zsdt.perception.segmentation import load_segmenter
    from zsdt.planning.first_look import seen_size
    from zsdt.planning.planner import plan_beam

    budget = cfg.budget
    if not live and not (budget.length and budget.height):
        segmenter = load_segmenter(parts.vision, cfg.twin.backend)
        length, height = seen_size(watched.source, segmenter, watched.scene, cfg.twin.loop)
        budget = replace(budget, length=length, height=height)
    plan = plan_beam(watched.scene, budget)
    print(f"plan: {plan.words}")
    return plan


def as_planned(cfg: SimpleNamespace, plan: Any) -> SimpleNamespace:
    """The options of a run with a plan put in: cadence, one run alone, and the first wanted field as the overlay."""
    from zsdt.planning.choices import with_cadence
    from zsdt.twin.field_scale import ShownName

    shown = {"velocity": ShownName.speed, "position": ShownName.displacement}.get(
        plan.scene.fields[0], ShownName.von_mises
    )
    twin = replace(
        cfg.twin, compare_open=False, loop=with_cadence(cfg.twin.loop, plan.choice),
        overlay=replace(cfg.twin.overlay, field=shown),
    )  # fmt: skip
    return SimpleNamespace(**{**vars(cfg), "twin": twin})


def _run(cfg: SimpleNamespace, parts: TwinWeights, watched: Watched, options: Any, sink: Any) -> Any:
    from zsdt.perception.depth import open_depth_maps
    from zsdt.perception.segmentation import load_segmenter
    from zsdt.tignn.engine import load_engine
    from zsdt.tignn.psi_ini import load
    from zsdt.twin.loop import run_twin

    cv2.setNumThreads(cfg.machine.threads)
    psi_ini = None
    if cfg.twin.first_stress is FirstStress.psi_ini and parts.psi_ini is not None:
        psi_ini = load(parts.psi_ini)
    return run_twin(
        watched.source, load_segmenter(parts.vision, cfg.twin.backend), watched.scene, options, camera=watched.camera,
        engine=load_engine(parts.tignn), psi_ini=psi_ini,
        depth_maps=open_depth_maps(watched.scene.depth_maps), sink=sink,
    )  # fmt: skip


def _truth(clip: Clip, sides: Any, body: Any) -> Any:
    """The truth of a clip; at the nodes of the twin where its graph is another one."""
    from zsdt.lab.beam_lab import node_grid
    from zsdt.planning.on_truth import truth_at
    from zsdt.twin.twin_view import truth_view

    if body.points.shape != clip.truth.body.points.shape:
        truth = truth_at(body, clip.truth, clip.clamp_side.front_layer != "low_y")
        return truth_view(truth, sides.twin, clip.true_camera)
    near = node_grid(clip.truth.body, clip.clamp_side)["near"]
    return truth_view(clip.truth, sides.twin, clip.true_camera, near)


def _figures(log: Any, sides: Any) -> dict[str, Any]:
    from zsdt.evaluation.beam_twin_cases import errors_of

    figures: dict[str, Any] = {"frames": log.count, "nodes": log.body.nodes, "stiffness": log.stiffness}
    figures["latency"] = {part: {k: row[k] for k in ("p50", "p99")} for part, row in log.latency_table().items()}
    if log.trust is not None:
        figures["trust"] = log.trust.figures()
    for name, view in ((log.mode, sides.twin), ("open", sides.open_loop)):
        if view is not None and sides.truth is not None:
            figures[name] = errors_of(view, sides.truth)
    return figures


def evaluate(clips: Path, parts: TwinWeights, options: Any, out: Path, scratch: Path, workers: int) -> dict[str, Any]:
    """Tables and a picture (see `zsdt.evaluation.beam_twin_report`)."""
    from zsdt.evaluation.beam_twin_report import evaluate_clips

    return evaluate_clips(clips, parts, options, out, workers)


BEAM = Kind(
    name="beam",
    weights="foam_beam",
    lab=BeamLabOptions,
    vision=(VisionOptions,),
    scene=BeamTwinScene,
    twin=TwinRun,
    evaluation=TwinEvaluationOptions,
    film=film,
    clips=ClipSet,
    told=told,
    placed=placed,
    train_vision=train_vision,
    watch=watch,
    evaluate=evaluate,
)
