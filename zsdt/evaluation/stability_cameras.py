"""Runs a hard case of a camera: the shipped twin on one painted clip of the virtual lab, with a trouble over it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from filelock import FileLock
from jaxtyping import UInt8

from zsdt.evaluation.beam_twin_cases import Case as ClipCase
from zsdt.evaluation.beam_twin_cases import position_error, scene_of, truth_of
from zsdt.evaluation.stability import left_range
from zsdt.evaluation.stability_camera_cases import CAMERA_CASES, CameraCase, Trouble
from zsdt.evaluation.stability_row import Outcome, Party, Row, books
from zsdt.evaluation.stability_trust import gauges_of
from zsdt.lab.beam_lab import BeamLabOptions
from zsdt.lab.clip_files import Storage
from zsdt.lab.clips import Clip, ClipSet, make_clips
from zsdt.lab.faults import FaultOptions, FaultySource, plan_faults
from zsdt.perception.camera import Camera
from zsdt.perception.segmentation import load_segmenter
from zsdt.perception.video import FrameSource, VideoFrame
from zsdt.shipped import TwinWeights
from zsdt.tignn.engine import Rollout, load_engine
from zsdt.tignn.psi_ini import load as load_psi_ini
from zsdt.trajectory import Trajectory
from zsdt.twin.log_view import view_of
from zsdt.twin.loop import TwinOptions, run_twin
from zsdt.twin.twin_errors import same_nodes
from zsdt.twin.twin_log import FrameStatus, TwinLog

FRAMES = max(case.frames for case in CAMERA_CASES)
HIDDEN_FRAMES = 30  # for which something is hidden
JUMP = 15  # frames between two jumps of the light
CLIP = BeamLabOptions(clips=1, frames=FRAMES, hand_fraction=1.0, mismatch=0.1, storage=Storage.video, mask_every=FRAMES)


def clip_in(folder: Path) -> Clip:
    """The clip, painted below `folder` if it is not there; one of several processes paints, the others wait."""
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_name(f".{folder.name}.lock")):
        make_clips(CLIP, folder)
    return ClipSet(folder)[0]


class Troubled:
    """The frames of a source with a trouble that changes pictures or their order."""

    def __init__(self, source: FrameSource, case: CameraCase):
        self.source, self.case = source, case
        self.name, self.fps, self.size = source.name, source.fps, source.size
        self.missing = source.missing

    @property
    def count(self) -> int | None:
        """Number of frames."""
        return self.source.count

    def __iter__(self) -> Iterator[VideoFrame]:
        case, frames = self.case, list(self.source)
        rng = np.random.default_rng([case.seed, 0xCA])
        shown = self._order(len(frames), rng)
        for k, frame in enumerate(frames):
            image = frames[shown[k]].image
            yield VideoFrame(frame.index, frame.time, image if k < case.start else self._picture(image, k, rng))

    def _order(self, count: int, rng: np.random.Generator) -> list[int]:
        """Which picture is shown when."""
        case, shown = self.case, list(range(count))
        if case.trouble is Trouble.swapped:
            k = case.start
            while k < count - 1:
                if rng.random() < 0.5 * case.size:
                    shown[k], shown[k + 1] = shown[k + 1], shown[k]
                    k += 1
                k += 1
        if case.trouble is Trouble.frozen:
            stop = min(case.start + int(case.size), count)
            shown[case.start : stop] = [case.start] * (stop - case.start)
        return shown

    def _picture(
        self, image: UInt8[np.ndarray, "h w 3"], k: int, rng: np.random.Generator
    ) -> UInt8[np.ndarray, "h w 3"]:
        case = self.case
        if case.trouble is Trouble.noise:
            return (image + case.size * rng.standard_normal(image.shape)).clip(0, 255).astype(np.uint8)
        if case.trouble is Trouble.blur:
            return np.asarray(cv2.GaussianBlur(image, (0, 0), case.size), np.uint8)
        if case.trouble is Trouble.exposure:
            factor = case.size if (k - case.start) // JUMP % 2 else 1.0 / case.size
            return np.asarray(cv2.convertScaleAbs(image, alpha=factor), np.uint8)
        if case.trouble is Trouble.jitter:
            moved = np.column_stack([np.eye(2), case.size * rng.standard_normal(2)])
            return np.asarray(
                cv2.warpAffine(image, moved, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE), np.uint8
            )
        return image


def source_of(clip: Clip, case: CameraCase) -> FrameSource:
    """The frames of the clip with the trouble of the case."""
    source, size = clip.source(), case.size
    if case.trouble in (Trouble.dropped, Trouble.doubled, Trouble.occlusion):
        faults = FaultOptions(seed=case.seed, protect=case.start)
        if case.trouble is Trouble.occlusion:
            faults = replace(faults, occlude_share=size, occlude_start=case.start, occlude_frames=HIDDEN_FRAMES)
        elif case.trouble is Trouble.dropped:
            faults = replace(faults, dropped=size)
        else:
            faults = replace(faults, doubled=size)
        return FaultySource(source, plan_faults(faults, clip.truth.frames, clip.pixels))
    return Troubled(source, case)


def camera_of(clip: Clip, case: CameraCase) -> Camera:
    """The camera that the twin is told."""
    if case.trouble is not Trouble.focal:
        return clip.camera
    matrix = clip.camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + case.size
    return replace(clip.camera, matrix=matrix)


def run_camera(case: CameraCase, clip: Clip, weights: TwinWeights) -> Row:
    """The twin in a case. Raises: DataError where it finds no grid, RunRejected where the engine finds no rest."""
    scene = scene_of(clip, ClipCase.closed)
    if case.trouble is Trouble.depth:
        scene = replace(scene, depth=scene.depth * (1.0 + case.size))
    log = run_twin(
        source_of(clip, case),
        load_segmenter(weights.vision),
        scene,
        TwinOptions(),
        camera=camera_of(clip, case),
        engine=load_engine(weights.tignn),
        psi_ini=None if weights.psi_ini is None else load_psi_ini(weights.psi_ini),
    )
    return _row(case, clip, log)


def _row(case: CameraCase, clip: Clip, log: TwinLog) -> Row:
    view = view_of(log, "virtual lab")
    truth = truth_of(clip, view, ClipCase.closed)
    length, young = float(np.ptp(log.body.points[:, 0])), clip.scene.material.young
    restarts = [k for k, status in enumerate(log.status) if status == FrameStatus.restarted.value]
    row = Row(case.name, case.kind, Party.twin, Outcome.bounded, "", case.frames)
    row.error = [float(x) for x in position_error(view, truth) / length]
    off = view.fields["stress"] - truth.fields["stress"][:, same_nodes(view, truth)]
    row.hidden = [float(x) for x in np.sqrt(np.square(off).mean(axis=(1, 2))) / young]
    row.energy_growth, row.entropy_min = books(log.account, restarts)
    found = {"stiffness_found": log.stiffness, "density_found": log.density}
    row.flags, row.gauges = gauges_of(log.trust, log.body, found)
    row.note = " ".join(f"{name}:{count}" for name, count in log.faults().items())
    still = Trajectory(log.body, log.times, {}, np.zeros((0, 0, 3)))
    left = left_range(still, Rollout("", {"position": log.positions}, np.zeros(0)))
    if left is not None:
        row.outcome, row.reason = Outcome.failed, f"left the range in which bodies can be at frame {left}"
    return row
