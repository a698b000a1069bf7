"""Runs twins on clips of the virtual lab with every choice that a planner has, and notes errors and times.

A row per clip and choice: errors [-] of all fields, milliseconds of the parts of a frame, those of the reference work
at the time, and the sizes that the times depend on. Milliseconds are of the processor, on one thread, so that a busy
machine does not spoil them; each part's are the median over the frames in which it was done, after the first few.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.errors import DataError, RunRejected
from zsdt.evaluation.beam_twin_cases import Case, scene_of
from zsdt.evaluation.glass_twin_cases import GlassCase, glass_errors, glass_scene_of, load_glass_engine, survival
from zsdt.lab.clips import read_clip
from zsdt.lab.glass_clips import read_glass_clip
from zsdt.perception.glass_segmentation import GlassMasks, GlassSegmenter, load_glass_segmenter
from zsdt.perception.segmentation import SegmentationBackend, load_segmenter, resolved
from zsdt.perception.video import FrameSource, VideoFrame
from zsdt.planning.choices import BEAM_CHOICES, GLASS_CHOICES, BeamChoice, GlassChoice
from zsdt.planning.on_truth import errors_on_truth
from zsdt.planning.reference import reference_ms
from zsdt.shipped import TwinWeights
from zsdt.tignn.engine import load_engine
from zsdt.tignn.psi_ini_liquid import load as load_psi_ini
from zsdt.twin.glass_log_view import glass_view_of
from zsdt.twin.glass_loop import GlassTwinOptions, run_glass_twin
from zsdt.twin.glass_view import glass_truth_view
from zsdt.twin.log_view import view_of
from zsdt.twin.loop import Clock, TwinOptions, run_twin

WARM_UP = 5  # frames
MOST_BRICKS = 1500  # finer graphs are far from any frame time
ROUNDS = 3  # of the reference work around each run
TIMED = 7  # pictures on which the segmentation is timed
Say = Callable[[str], None]
Row = dict[str, Any]


def measure_beams(
    folders: Iterable[Path], weights: TwinWeights, choices: Sequence[BeamChoice] = BEAM_CHOICES, say: Say = print
) -> list[Row]:
    """A row for each clip and choice that its beam can be cut for. Nothing is drawn; the first stress is the engine's
    own rest."""
    segmenter, engine = load_segmenter(weights.vision), load_engine(weights.tignn)
    rows = []
    for folder in folders:
        clip = read_clip(folder)
        told = replace(scene_of(clip, Case.closed), fields=["velocity", "stress"])
        length, width, height = np.ptp(clip.truth.body.points, axis=0)
        reel = Reel(clip.source())
        about = {"clip": clip.name, "regime": str(clip.truth.meta["regime"]), "length": length, "width": width}
        about |= {"height": height, "pitch": told.pitch, "fps": clip.scene.fps, "wave": wave_speed(told.material)}
        for number, choice in enumerate(warmed(choices)):
            if (
                not fits(choice, told.pitch, length, width, height)
                or bricks_of(choice, told.pitch, length, width, height) > MOST_BRICKS
            ):
                continue
            options = TwinOptions(look_every=choice.look_every)
            before = reference_ms(ROUNDS)
            try:
                log = run_twin(
                    reel, segmenter, choice.scene(told), options, camera=clip.camera, engine=engine, clock=CpuClock()
                )
            except RunRejected as reason:
                rows.append({**about, **choice.columns(), "reason": str(reason)})
                continue
            if number == 0:  # only to have everything compiled
                continue
            parts = medians(log.latency, WARM_UP)
            row = {
                **about, **choice.columns(), "nodes": log.body.nodes, "points": log.front_nodes.size,
                "brick_count": len(log.body.cells), "reference_ms": 0.5 * (before + reference_ms(ROUNDS)),
                **{f"{part}_ms": parts.get(part, 0.0) for part in ("predict", "track", "correct", "decode", "trust")},
                **errors_on_truth(view_of(log), clip.truth, choice.one_layer),
                "reason": "it had to start again" if "restarted" in log.status else "",
            }  # fmt: skip
            rows.append(row)
            say(told_row(row, choice.words(told)))
    return rows


def wave_speed(material: Any) -> float:
    """Speed [m/s] to which the sub-step of a solid is tied."""
    return float(np.sqrt(material.young / material.density))


def fits(choice: BeamChoice, pitch: float, *sizes: float) -> bool:
    """Whether a beam of these sizes [m] (length, width, height) can be cut into cells of this choice."""
    cell = pitch / choice.cells
    cut = [size / cell for axis, size in enumerate(sizes) if not (choice.one_layer and axis == 1)]
    return all(abs(n - round(n)) < 1e-3 and round(n) >= 1 for n in cut) and sizes[0] / max(cell, pitch) > 1.5


def bricks_of(choice: BeamChoice, pitch: float, length: float, width: float, height: float) -> float:
    """Cells of the graph."""
    cell = pitch / choice.cells
    return length / cell * (1.0 if choice.one_layer else width / cell) * height / cell


def warmed(choices: Sequence[Any]) -> list[Any]:
    """The choices with the first one twice: what it takes to compile is nobody's."""
    return [choices[0], *choices]


def medians(latency: dict[str, np.ndarray], skip: int) -> dict[str, float]:
    """Median time [ms] of each part over the frames in which it was done."""
    return {p: float(np.nanmedian(v[skip:])) if np.isfinite(v[skip:]).any() else 0.0 for p, v in latency.items()}


def told_row(row: Row, words: str) -> str:
    """A row in a line."""
    parts = sum(v for name, v in row.items() if name.endswith("_ms") and name != "reference_ms")
    errors = {n: f"{100 * row[n]:.1f}" for n in ("position", "velocity", "stress", "von_mises") if n in row}
    return f"{row['clip']} {row['regime']}: {words}: {parts:.1f} ms for a frame with a look, errors in % {errors}"


class CpuClock(Clock):
    """Time that this process has computed: what others do on the machine meanwhile does not count."""

    def now(self) -> float:
        """Seconds of the processor."""
        return time.process_time()


class Reel:
    """The frames of a clip, read once for all choices."""

    def __init__(self, source: FrameSource):
        self.name, self.fps, self.size, self.missing = source.name, source.fps, source.size, source.missing
        self.count, self.frames = source.count, list(source)

    def __iter__(self) -> Iterator[VideoFrame]:
        """All of them."""
        return iter(self.frames)


@dataclass
class KeptMasks:
    """A segmenter that remembers what it saw in a picture, so that the choices of one clip need it only once."""

    segmenter: GlassSegmenter

    def __post_init__(self) -> None:
        self._kept: dict[bytes, GlassMasks] = {}
        self.asked: list[tuple[np.ndarray, Any]] = []

    def masks(self, image: np.ndarray, window: Any = None) -> GlassMasks:
        """See `GlassSegmenter`."""
        key = hashlib.blake2b(np.ascontiguousarray(image).tobytes(), digest_size=16)
        key.update(repr(window).encode())
        if key.digest() not in self._kept:
            self._kept[key.digest()] = self.segmenter.masks(image, window)
            self.asked = [*self.asked, (image, window)][-TIMED:]
        return self._kept[key.digest()]

    def milliseconds(self, segmenter: GlassSegmenter) -> float:
        """Median time [ms] in which a segmenter answers the last questions."""
        times = []
        for image, window in self.asked:
            began = time.process_time()
            segmenter.masks(image, window)
            times.append(1e3 * (time.process_time() - began))
        return float(np.median(times))


def measure_glasses(
    folders: Iterable[Path],
    weights: TwinWeights,
    choices: Sequence[GlassChoice] = GLASS_CHOICES,
    say: Say = print,
    segmenter_of: Callable[[Any], GlassSegmenter] | None = None,
) -> list[Row]:
    """A row for each clip and choice. segmenter_of(clip): another segmenter than that of the weights, such as the lab's
    own masks. The time of the segmentation is that of the weights by the fastest backend, on pictures of each clip."""
    fastest = resolved(SegmentationBackend.fastest)
    shared, engine = load_glass_segmenter(weights.vision, fastest), load_glass_engine(weights.tignn)
    psi_ini = None if weights.psi_ini is None else load_psi_ini(weights.psi_ini)
    rows: list[Row] = []
    for folder in folders:
        clip = read_glass_clip(folder)
        body = clip.truth.body
        assert body.liquid is not None and body.vessel is not None
        reel = Reel(clip.source())
        kept = KeptMasks(shared if segmenter_of is None else segmenter_of(clip))
        about = {"clip": clip.name, "regime": body.vessel.family.value, "fps": clip.scene.fps}
        about["volume"] = float(body.mass.sum()) / body.liquid.density
        about |= {"masks": "segmented" if segmenter_of is None else "lab", "backend": fastest.value}
        segment_ms, segment_reference = 0.0, 1.0
        for number, choice in enumerate(warmed(choices)):
            told = replace(choice.scene(glass_scene_of(clip, GlassCase.closed, choice.particles)), fields=["velocity"])
            options = GlassTwinOptions(look_every=choice.look_every, beside=False)
            before = reference_ms(ROUNDS)
            try:
                log = run_glass_twin(
                    reel, kept, told, options, camera=clip.camera, engine=choice.engine(engine),
                    psi_ini=psi_ini, clock=CpuClock(),
                )  # fmt: skip
            except (RunRejected, DataError) as reason:
                rows.append({**about, **choice.columns(), "reason": str(reason)})
                say(f"{clip.name} {choice.words(told)}: {reason}")
                continue
            reference = 0.5 * (before + reference_ms(ROUNDS))
            if number == 0:
                segment_ms, segment_reference = kept.milliseconds(shared), reference
                continue
            view = glass_view_of(log, "virtual lab")
            truth = glass_truth_view(clip.truth, clip.pose, clip.true_camera, view)
            survived, reason_given = survival(view, truth)
            figures = glass_errors(view, truth)
            parts = medians({k: v[log.start :] for k, v in log.latency.items()}, WARM_UP)
            row = {
                **about, **choice.columns(), "nodes": log.body.nodes, "reference_ms": reference,
                "segment_ms": segment_ms * reference / segment_reference,
                **{f"{part}_ms": parts.get(part, 0.0) for part in ("predict", "observe", "correct", "decode", "trust")},
                "position": figures["level_share"], "velocity": figures["vertical_velocity_rrmse"],
                "reason": reason_given if not survived else "",
            }  # fmt: skip
            rows.append(row)
            say(told_row(row, choice.words(told)))
    return rows
