"""Sim-to-real of the beam twin: clips of the virtual lab, each seen by the twin under several conditions.

Every clip shows a beam that no network has met, of a material that is not the told one, under a load that nobody
tells. `judge_clip` runs the twin on one clip in one case and compares all nodes, hidden ones included, with the truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError, RunRejected
from zsdt.evaluation.metrics import field_errors, rrmse
from zsdt.lab.beam_lab import node_grid
from zsdt.lab.clips import Clip, read_clip
from zsdt.lab.faults import FaultOptions, FaultySource, plan_faults
from zsdt.perception.segmentation import SegmentationBackend, load_segmenter
from zsdt.perception.video import FrameSource, VideoFrame
from zsdt.shipped import TwinWeights
from zsdt.tignn.engine import load_engine
from zsdt.tignn.psi_ini import load as load_psi_ini
from zsdt.trajectory import Trajectory
from zsdt.twin.log_view import view_of
from zsdt.twin.loop import LoopMode, TwinOptions, run_twin
from zsdt.twin.twin_errors import same_nodes
from zsdt.twin.twin_log import TwinLog
from zsdt.twin.twin_scene import BeamTwinScene
from zsdt.twin.twin_view import TwinView, truth_view

HIDDEN = ["position", "velocity", "stress"]
WRONG = 0.2  # relative error of the Young's modulus in the cases with a wrong material
LONGEST = 3.0  # lengths of the beam from the truth, above which a run has diverged


class Case(StrEnum):
    """Conditions of a run.

    open, closed: the material as told in the clip. own_rest: closed, but the first stress is that of the engine's own
    rest instead of Psi_ini's. open_wrong, closed_wrong, own_rest_wrong: a Young's modulus that is 20 % off.
    occluded: half of the nodes are hidden for 30 frames. dropped: 10 % of the frames never come. long: the clip is
    played forwards and backwards for 1,000 frames.
    """

    open = "open"
    closed = "closed"
    own_rest = "own_rest"
    open_wrong = "open_wrong"
    closed_wrong = "closed_wrong"
    own_rest_wrong = "own_rest_wrong"
    occluded = "occluded"
    dropped = "dropped"
    long = "long"


OPEN = (Case.open, Case.open_wrong)
WRONG_CASES = (Case.open_wrong, Case.closed_wrong, Case.own_rest_wrong, Case.long)
OWN_REST = (Case.own_rest, Case.own_rest_wrong)


@dataclass
class TwinEvaluationOptions:
    """cases: which conditions. long_frames: of the case long. occluded_share of the nodes are hidden for
    occluded_frames; dropped: share of the frames. backend: of the segmentation. loop: of the twin. warm_up: frames
    before the clock starts."""

    cases: list[Case] = field(default_factory=lambda: list(Case))
    long_frames: int = 1000
    occluded_share: float = 0.5
    occluded_frames: int = 30
    dropped: float = 0.1
    warm_up: int = 5
    backend: SegmentationBackend = SegmentationBackend.fastest
    loop: TwinOptions = field(default_factory=TwinOptions)

    def __post_init__(self) -> None:
        if not self.cases or self.long_frames < 10 or self.occluded_frames < 1:
            raise OptionError("Name at least one case; long_frames must be at least 10 and occluded_frames 1.")
        if not 0 < self.occluded_share <= 1 or not 0 < self.dropped < 1:
            raise OptionError("occluded_share must lie in (0, 1] and dropped in (0, 1).")


class PingPongSource:
    """A finite source played forwards and backwards until `count` frames have come."""

    def __init__(self, source: FrameSource, count: int):
        self.name, self.fps, self.size, self.count = source.name, source.fps, source.size, count
        self.missing: list[int] = []
        self._source = source

    def __iter__(self) -> Iterator[VideoFrame]:
        """Frames with running numbers and times."""
        images = [frame.image for frame in self._source]
        for k, shown in enumerate(there_and_back(len(images), self.count)):
            yield VideoFrame(k, k / self.fps, images[shown])


def there_and_back(length: int, count: int) -> list[int]:
    """Numbers 0 .. length - 1 forwards and backwards without a doubled end, `count` of them."""
    turn = [*range(length), *range(length - 2, 0, -1)]
    return [turn[k % len(turn)] for k in range(count)]


def scene_of(clip: Clip, case: Case) -> BeamTwinScene:
    """What the twin is told about a clip; in the cases with a wrong material E is off by 20 %, up or down in turn."""
    told = clip.scene
    material = told.material
    if case in WRONG_CASES:
        true = clip.truth.body.material
        assert true is not None
        sign = 1.0 if sum(clip.name.encode()) % 2 else -1.0
        material = replace(material, young=true.young * (1.0 + sign * WRONG))
    return BeamTwinScene(
        width=told.beam_width,
        pitch=told.pitch,
        material=material,
        gravity=told.gravity,
        fps=told.fps,
        depth=told.depth,
        fields=list(HIDDEN),
    )


def source_of(clip: Clip, case: Case, options: TwinEvaluationOptions) -> FrameSource:
    """The frames of a clip with the faults of the case."""
    source = clip.source()
    if case is Case.long:
        return PingPongSource(source, options.long_frames)
    if case not in (Case.occluded, Case.dropped):
        return source
    if case is Case.occluded:
        faults = FaultOptions(occlude_share=options.occluded_share, occlude_frames=options.occluded_frames)
    else:
        faults = FaultOptions(dropped=options.dropped)
    return FaultySource(source, plan_faults(faults, clip.truth.frames, clip.pixels))


def run_case(clip: Clip, case: Case, weights: TwinWeights, options: TwinEvaluationOptions) -> TwinLog:
    """The twin on a clip in one case.

    Raises: DataError where it finds no grid, RunRejected where the engine finds no rest.
    """
    mode = LoopMode.open if case in OPEN else LoopMode.closed
    return run_twin(
        source_of(clip, case, options),
        load_segmenter(weights.vision, options.backend),
        scene_of(clip, case),
        replace(options.loop, mode=mode),
        camera=clip.camera,
        engine=load_engine(weights.tignn),
        psi_ini=None if weights.psi_ini is None or case in OWN_REST else load_psi_ini(weights.psi_ini),
    )


def truth_of(clip: Clip, view: TwinView, case: Case) -> TwinView:
    """The truth at the frames of a run."""
    truth = clip.truth
    if case is Case.long:
        shown = there_and_back(truth.frames, int(view.frames.max()) + 1)
        truth = Trajectory(
            truth.body, np.arange(len(shown)) * truth.body.frame_dt, {k: v[shown] for k, v in truth.fields.items()},
            truth.load[shown], {}, truth.meta,
        )  # fmt: skip
    return truth_view(truth, view, clip.true_camera, node_grid(truth.body, clip.clamp_side)["near"])


def judge_clip(folder: str, case: str, weights: TwinWeights, options: TwinEvaluationOptions) -> dict[str, Any]:
    """One row: errors of all free nodes [-, m, Pa], drift, innovation, latency, survival; and curves over the frames.

    A run that cannot be done is a row too, with its reason.
    """
    clip, kind = read_clip(folder), Case(case)
    row: dict[str, Any] = {"clip": clip.name, "case": kind.value, "regime": str(clip.truth.meta.get("regime", ""))}
    try:
        log = run_case(clip, kind, weights, options)
    except RunRejected as error:
        return {**row, "survived": False, "reason": str(error), "curve": []}
    view = view_of(log, "virtual lab")
    truth = truth_of(clip, view, kind)
    row |= {"nodes": log.body.nodes, "front_nodes": int(log.front_nodes.size), "frames": log.count}
    row |= errors_of(view, truth)
    row |= speeds_of(log, options.warm_up)
    row |= {"faults": " ".join(f"{name}:{count}" for name, count in log.faults().items())}
    seen = np.isfinite(log.innovation)
    row["innovation_mm"] = 1e3 * float(np.sqrt(np.mean(log.innovation[seen] ** 2))) if seen.any() else float("nan")
    row["stiffness"] = log.stiffness
    if log.trust is not None:
        row |= {"flagged_frames": sum(map(bool, log.trust.flags)), "first_flag_frame": log.trust.first_flag}
    away = position_error(view, truth)
    length = float(np.ptp(log.body.points[:, 0]))
    row["survived"] = bool(np.isfinite(away).all() and away.max() < LONGEST * length)
    row["reason"] = "" if row["survived"] else "diverged"
    return {**row, "curve": [float(x) for x in away]}


def position_error(view: TwinView, truth: TwinView) -> Float[np.ndarray, " frames"]:
    """Root mean square distance of the free nodes from the truth [m] in each frame."""
    free = ~view.body.clamped
    off = view.positions[:, free] - truth.positions[:, same_nodes(view, truth)][:, free]
    return np.sqrt(np.square(off).sum(axis=2).mean(axis=1))


def errors_of(view: TwinView, truth: TwinView) -> dict[str, float]:
    """Errors of a whole run as DESIGN 6 defines them, von Mises at the clamp, and how fast the position error grows."""
    there = same_nodes(view, truth)
    ours = {"position": view.positions, **view.fields}
    theirs = {"position": truth.positions[:, there], **{k: v[:, there] for k, v in truth.fields.items() if k in ours}}
    found = field_errors(ours, theirs, ~view.body.clamped)
    kept = ("position", "displacement", "velocity", "stress", "von_mises")
    figures = {
        f"{n}_{kind}": found[f"{n}_{kind}"] for n in kept for kind in ("rmse", "rrmse") if f"{n}_{kind}" in found
    }
    clamp = view.body.clamped
    if view.shows("von_mises"):
        figures["clamp_von_mises_rrmse"] = rrmse(
            view.values("von_mises")[1:, clamp, None], truth.values("von_mises")[1:][:, there][:, clamp, None]
        )
    curve = position_error(view, truth)
    figures["drift_mm_per_s"] = 1e3 * float(np.polyfit(view.times - view.times[0], curve, 1)[0])
    return figures


def speeds_of(log: TwinLog, warm_up: int) -> dict[str, float]:
    """Median, 95th and 99th percentile [ms] of every part and of the whole loop (without capture)."""
    table = log.latency_table(warm_up)
    return {f"{part}_{name}_ms": value for part, row in table.items() for name, value in row.items() if name != "max"}
