"""Sim-to-real of the glass twin: clips of the virtual lab, each seen by the twin under several conditions.

Every clip shows a liquid of another viscosity than the told one, in a vessel that no network has met, simulated with
other particles. `judge_glass_clip` runs the twin on one clip in one case and compares it with the truth from t0 on.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.evaluation.liquid_metrics import outside
from zsdt.evaluation.sloshing import main_direction, swing_figures
from zsdt.evaluation.true_masks import TrueMasks
from zsdt.interop.inference import with_backend
from zsdt.lab.faults import FaultPlan, FaultySource
from zsdt.lab.glass_clips import GlassClip, read_glass_clip
from zsdt.lab.glass_faults import GlassFaultOptions, plan_glass_faults
from zsdt.perception.camera import Camera
from zsdt.perception.glass_segmentation import GlassSegmenter, load_glass_segmenter
from zsdt.perception.segmentation import SegmentationBackend
from zsdt.perception.video import FrameSource
from zsdt.shipped import TwinWeights
from zsdt.tignn.engine import Engine, load_engine
from zsdt.tignn.inference import InferenceBackend
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.tignn.psi_ini_liquid import load as load_psi_ini
from zsdt.twin.glass_errors import (
    Between,
    error_and_floor,
    error_curves,
    rest_time,
    share_of_truth,
    vertical_velocity_rrmse,
)
from zsdt.twin.glass_log import GlassTwinLog
from zsdt.twin.glass_log_view import glass_view_of
from zsdt.twin.glass_loop import GlassTwinOptions, run_glass_twin
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.glass_view import GlassTwinView, glass_truth_view
from zsdt.twin.liquid_assimilation import LiquidMethod
from zsdt.twin.liquid_history import FirstState
from zsdt.twin.liquid_node_engine import twin_engine_of
from zsdt.twin.loop_common import LoopMode

HIDDEN = ["velocity", "internal_energy"]
FARTHEST = 1.0  # fill heights that a level may be off before a run has diverged
LONGEST_LAG = 0.15  # s, within which the lag of a swing is looked for


class GlassCase(StrEnum):
    """Conditions of a run.

    open, closed: as told in the clip, viscosity up to 20 % off. seed_open, columns: the open loop of the seed,
    begun by Psi_ini, and its closed loop, corrected column by column. masks_seed_open, masks_open, masks,
    masks_columns: the same loops with the lab's own masks instead of a segmentation, as a perfect one would see;
    masks_high: closed, with masks whose liquid ends two pixels too high. told_open, told: with a segmentation, told the
    true viscosity and the true camera. dropped: 10 % of the frames never come. dark, frozen, blurred: 10 % are that.
    hand: a sleeve hides two thirds of the glass for a quarter of a second. leaving: the camera turns until the glass
    has left the picture, and back.
    """

    seed_open = "seed_open"
    open = "open"
    closed = "closed"
    columns = "columns"
    masks_seed_open = "masks_seed_open"
    masks_open = "masks_open"
    masks = "masks"
    masks_columns = "masks_columns"
    masks_high = "masks_high"
    told_open = "told_open"
    told = "told"
    dropped = "dropped"
    dark = "dark"
    frozen = "frozen"
    blurred = "blurred"
    hand = "hand"
    leaving = "leaving"


OPEN = (
    GlassCase.seed_open, GlassCase.open, GlassCase.masks_seed_open, GlassCase.masks_open, GlassCase.told_open,
)  # fmt: skip
MASKS = (
    GlassCase.masks_seed_open, GlassCase.masks_open, GlassCase.masks, GlassCase.masks_columns, GlassCase.masks_high,
)  # fmt: skip
COLUMNS = (GlassCase.columns, GlassCase.masks_columns)
SEED = (GlassCase.seed_open, GlassCase.masks_seed_open, *COLUMNS)
HIGH = 2  # px by which the liquid of `masks_high` ends too high
TOLD = (GlassCase.told, GlassCase.told_open)
FAULTS = {
    GlassCase.dropped: GlassFaultOptions(dropped=0.1),
    GlassCase.dark: GlassFaultOptions(dark=0.1),
    GlassCase.frozen: GlassFaultOptions(doubled=0.1),
    GlassCase.blurred: GlassFaultOptions(blurred=0.1),
    GlassCase.hand: GlassFaultOptions(occlude_share=0.67, occlude_frames=15),
    GlassCase.leaving: GlassFaultOptions(leave_frames=4, leave_away=6),
}
AFTER = 10  # frames after t0 at which a hand comes or the glass leaves


@dataclass
class GlassTwinEvaluationOptions:
    """cases: which conditions. backend: of the segmentation; true_masks: the lab's own masks instead of it in every
    case, of what a hand or a turned camera leaves to be seen, too. particles: of the twin. loop: of the twin. warm_up:
    frames after t0 before the clock starts."""

    cases: list[GlassCase] = field(default_factory=lambda: list(GlassCase))
    warm_up: int = 5
    particles: int = 700
    backend: SegmentationBackend = SegmentationBackend.fastest
    true_masks: bool = False
    loop: GlassTwinOptions = field(default_factory=GlassTwinOptions)

    def __post_init__(self) -> None:
        if not self.cases or self.warm_up < 0 or self.particles < 50:
            raise OptionError("Name at least one case; warm_up must not be negative and particles at least 50.")


def glass_scene_of(clip: GlassClip, case: GlassCase, particles: int) -> GlassTwinScene:
    """What the twin is told about a clip; in the told cases the true liquid."""
    card = clip.scene
    true = clip.truth.body.liquid
    assert true is not None
    return GlassTwinScene(
        liquid=true if case in TOLD else card.liquid,
        wall=card.wall,
        floor=card.floor,
        glass_index=card.glass_index,
        liquid_index=card.liquid_index,
        section=None if card.section is None else list(card.section),
        gravity=card.gravity,
        fps=card.fps,
        particles=particles,
        fields=list(HIDDEN),
    )


def glass_faults_of(clip: GlassClip, case: GlassCase) -> FaultPlan:
    """The faults of a case; none in most."""
    if case not in FAULTS:
        return FaultPlan()
    when = clip.t0_frame + AFTER
    return plan_glass_faults(replace(FAULTS[case], occlude_start=when, leave_start=when), clip)


def load_glass_engine(folder: str | Path) -> Engine:
    """The engine of a glass twin; a network is computed by compiled loops, as in a rollout.

    Raises: DataError where the folder holds none, or one of another form.
    """
    engine = load_engine(folder)
    if isinstance(engine, ParticleEngine):
        return engine
    return twin_engine_of(with_backend(engine, InferenceBackend.kernel), folder)


def run_glass_case(
    clip: GlassClip, case: GlassCase, weights: TwinWeights, options: GlassTwinEvaluationOptions
) -> GlassTwinLog:
    """The twin on a clip in one case.

    Raises: DataError where it finds no glass or no t0, RunRejected where it finds no liquid to follow.
    """
    loop = replace(options.loop, mode=LoopMode.open if case in OPEN else LoopMode.closed)
    if case in SEED:
        loop = replace(loop, first_state=FirstState.psi_ini)
    if case in COLUMNS:
        loop = replace(loop, assimilation=replace(loop.assimilation, method=LiquidMethod.columns))
    plan = glass_faults_of(clip, case)
    source: FrameSource = FaultySource(clip.source(), plan) if plan.of else clip.source()
    segmenter: GlassSegmenter
    if case in MASKS or options.true_masks:
        segmenter = TrueMasks(clip, source, plan, HIGH if case is GlassCase.masks_high else 0)
    else:
        segmenter = load_glass_segmenter(weights.vision, options.backend)
    camera: Camera = clip.true_camera if case in TOLD else clip.camera
    return run_glass_twin(
        source,
        segmenter,
        glass_scene_of(clip, case, options.particles),
        loop,
        camera=camera,
        engine=load_glass_engine(weights.tignn),
        psi_ini=None if weights.psi_ini is None else load_psi_ini(weights.psi_ini),
    )


def judge_glass_clip(
    folder: str, case: str, weights: TwinWeights, options: GlassTwinEvaluationOptions
) -> dict[str, Any]:
    """One row: errors, swing, rest, volume, latency, survival; and curves over the frames after t0.

    A run that cannot be done is a row too, with its reason.
    """
    clip, kind = read_glass_clip(folder), GlassCase(case)
    body = clip.truth.body
    assert body.liquid is not None and body.vessel is not None
    row: dict[str, Any] = {"clip": clip.name, "case": kind.value, "family": body.vessel.family.value}
    row["viscosity_ratio"] = body.liquid.viscosity / clip.scene.liquid.viscosity
    try:
        log = run_glass_case(clip, kind, weights, options)
    except (RunRejected, DataError) as error:
        return {**row, "survived": False, "reason": str(error), "curves": {}}
    view = glass_view_of(log, "virtual lab")
    truth = glass_truth_view(clip.truth, clip.pose, clip.true_camera, view)
    row |= {"particles": log.body.nodes, "frames": log.count - log.start}
    row["t0_error_frames"] = int(log.frames[log.start]) - clip.t0_frame
    figures, found = errors_and_curves(view, truth)
    row |= figures
    row |= glass_speeds(log, options.warm_up)
    row["faults"] = " ".join(f"{name}:{count}" for name, count in log.faults().items())
    innovation = view.innovation_rms()
    known = innovation[np.isfinite(innovation)]
    row["innovation_mm"] = 1e3 * float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
    if log.trust is not None:
        row |= {"flagged_frames": sum(map(bool, log.trust.flags)), "first_flag_frame": log.trust.first_flag}
    row["survived"], row["reason"] = survival(view, truth)
    curves = {name: [float(x) for x in curve] for name, curve in found.items()}
    curves["rise"] = [float(x) for x in view.rise()]
    curves["true_rise"] = [float(x) for x in truth.rise()]
    return {**row, "curves": curves}


def survival(view: GlassTwinView, truth: GlassTwinView) -> tuple[bool, str]:
    """Whether a run stayed finite, in its vessel and near the truth; and why not."""
    if not np.isfinite(view.positions).all():
        return False, "not finite"
    leaked, _ = outside(view.body, view.positions)
    if len(leaked):
        return False, f"{len(leaked)} particles leaked"
    if float(np.abs(view.level - truth.level).max()) > FARTHEST * fill_height(truth):
        return False, "diverged"
    return True, ""


def fill_height(truth: GlassTwinView) -> float:
    """Height [m] of the liquid at rest: up to which its volume fills the vessel."""
    body = truth.body
    assert body.liquid is not None
    return truth.vessel.level(float(body.mass.sum()) / body.liquid.density)


def glass_errors(view: GlassTwinView, truth: GlassTwinView) -> dict[str, float]:
    """Errors of a whole run, over all frames after t0 but the first.

    level: profile of the surface [mm], [px] in the picture, and over the fill height; centroid [mm]; vertical velocity:
    RRMSE [-], its floor, and as a mean of near particles tells it (see `zsdt.twin.glass_errors`); frequency, damping,
    lag [ms] of the swing; rest [s]: when the vertical velocity has died down; volume: drift of the run and error of
    what was reconstructed [-].
    """
    return errors_and_curves(view, truth)[0]


def errors_and_curves(
    view: GlassTwinView, truth: GlassTwinView
) -> tuple[dict[str, float], dict[str, Float[np.ndarray, " moving"]]]:
    """`glass_errors`, and the curves over the frames that they were made of."""
    loudest = float(truth.rise().max())
    off, least = error_and_floor(view, truth)
    curves = error_curves(view, truth, off)
    level = float(np.sqrt(np.mean(curves["level_mm"][1:] ** 2)))
    fill = fill_height(truth)
    depth = float(truth.camera.depths(truth.origin[-1][None])[0])
    figures = {
        "level_mm": level,
        "level_px": 1e-3 * level * float(truth.camera.matrix[0, 0]) / depth,
        "level_share": 1e-3 * level / fill,
        "level_worst_share": 1e-3 * float(curves["level_mm"][1:].max()) / fill,
        "centroid_mm": float(np.sqrt(np.mean(curves["centroid_mm"][1:] ** 2))),
        "vertical_velocity_rrmse": share_of_truth(off, truth),
        "vertical_velocity_floor": share_of_truth(least, truth),
        "vertical_velocity_mean_rrmse": vertical_velocity_rrmse(view, truth, Between.near_mean),
    }
    direction = main_direction(truth.centroid())
    ours, theirs = view.centroid() @ direction, truth.centroid() @ direction
    step = float(np.median(np.diff(view.clock)))
    figures |= swing_figures(ours, theirs, step, truth.body.pitch)
    figures["lag_ms"] = 1e3 * lag_of(ours, theirs, step)
    figures["rest_s"], figures["true_rest_s"] = rest_time(view, loudest), rest_time(truth, loudest)
    figures["rest_frame"], figures["true_rest_frame"] = (
        round(figures[name] / step) for name in ("rest_s", "true_rest_s")
    )
    figures["rest_ratio"] = figures["rest_s"] / max(figures["true_rest_s"], step)
    return figures | volumes_of(view, truth), curves


def volumes_of(view: GlassTwinView, truth: GlassTwinView) -> dict[str, float]:
    """Largest change of the volume below the surface during the run, and error of the liquid's amount at t0 [-]."""
    body, true = view.body, truth.body
    assert body.liquid is not None and true.liquid is not None
    amount = float(body.mass.sum()) / body.liquid.density
    true_amount = float(true.mass.sum()) / true.liquid.density
    volume = np.asarray(view.account.get("volume", np.full(1, np.nan)))
    return {
        "volume_error": amount / true_amount - 1.0,
        "volume_drift": float(np.abs(volume / volume[0] - 1.0).max()),
    }


def lag_of(ours: Float[np.ndarray, " frames"], theirs: Float[np.ndarray, " frames"], step: float) -> float:
    """By how many seconds a swing is late (positive) against the true one: the shift that correlates them best, finer
    than a frame by a parabola through the best three; NaN where one of them does not move."""
    a, b = ours - ours[-1], theirs - theirs[-1]
    most = min(int(LONGEST_LAG / step), len(a) // 3)
    if most < 1 or min(float(np.ptp(a)), float(np.ptp(b))) <= 0:
        return float("nan")
    shifts = np.arange(-most, most + 1)
    scores = []
    for shift in shifts:
        x, y = (a[shift:], b[: len(b) - shift]) if shift >= 0 else (a[:shift], b[-shift:])
        scores.append(float(x @ y) / max(float(np.linalg.norm(x) * np.linalg.norm(y)), 1e-30))
    best = int(np.argmax(scores))
    fine = 0.0
    if 0 < best < len(scores) - 1:
        left, here, right = scores[best - 1 : best + 2]
        bend = left - 2.0 * here + right
        fine = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return step * (float(shifts[best]) + fine)


def glass_speeds(log: GlassTwinLog, warm_up: int) -> dict[str, float]:
    """Median, 95th and 99th percentile [ms] of every part and of the whole loop (without capture) after t0."""
    table = log.latency_table(warm_up)
    return {f"{part}_{name}_ms": value for part, row in table.items() for name, value in row.items() if name != "max"}
