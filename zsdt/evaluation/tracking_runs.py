"""Runs of the tracker with its errors, beside plain frame-to-frame Lucas-Kanade on the same pictures."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from zsdt.errors import DataError
from zsdt.evaluation.tracking_scenes import OCCLUDED
from zsdt.interop.dic_images import DicImages
from zsdt.perception.local_motion import lattice_edges
from zsdt.perception.optical_flow import GridTracker, TrackerOptions
from zsdt.perception.video import open_video

RECOVERY = 3  # frames after an occlusion until nodes must be back
BACK = 1.0  # px within which a node is back
PLAIN_WINDOW, PLAIN_LEVELS = 21, 3
WARM_UP = 3  # frames that do not count for the time per frame
# The specimen goes on beyond the outermost points: nothing is masked.
DIC_OPTIONS = TrackerOptions(window=31, mask_background=False)


@dataclass(frozen=True)
class Follow:
    """What a tracker made of a sequence: error [frames, nodes] px, seen [frames, nodes], pixels [frames, nodes, 2],
    milliseconds [frames - 1] of the processor; the first frame is given."""

    error: Float[np.ndarray, "frames nodes"]
    seen: Bool[np.ndarray, "frames nodes"]
    pixels: Float[np.ndarray, "frames nodes 2"]
    milliseconds: Float[np.ndarray, " later"]


def follow(
    images: Sequence[Any],
    truth: Float[np.ndarray, "frames nodes 2"],
    edges: Int[np.ndarray, "edges 2"],
    options: TrackerOptions | None = None,
    twin: float | None = None,
) -> Follow:
    """Tracks from the exact nodes of the first frame.

    twin: gives predictions whose displacements since the first frame are too small by this share, as those of a twin
    with a wrong material would be; None: no predictions.
    """
    tracker = GridTracker(options)
    tracker.start(images[0], truth[0], edges)
    pixels, seen, times = [truth[0]], [np.ones(len(truth[0]), bool)], []
    for frame, image in enumerate(images[1:], start=1):
        predicted = None if twin is None else truth[frame] - twin * (truth[frame] - truth[0])
        begin = time.thread_time()
        tracks = tracker.track(image, predicted)
        times.append(1e3 * (time.thread_time() - begin))
        pixels.append(tracks.pixels)
        seen.append(tracks.seen)
    found = np.stack(pixels)
    return Follow(np.linalg.norm(found - truth, axis=2), np.stack(seen), found, np.array(times))


def chain(images: Sequence[Any], truth: Float[np.ndarray, "frames nodes 2"]) -> Follow:
    """The yardstick: OpenCV's pyramidal Lucas-Kanade from frame to frame, nothing else."""
    before = cv2.cvtColor(images[0], cv2.COLOR_BGR2GRAY)
    pixels, seen, times = [truth[0]], [np.ones(len(truth[0]), bool)], []
    for image in images[1:]:
        begin = time.thread_time()
        after = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        old = pixels[-1].astype(np.float32)
        new, found, _ = cv2.calcOpticalFlowPyrLK(
            before, after, old, old.copy(), winSize=(PLAIN_WINDOW, PLAIN_WINDOW), maxLevel=PLAIN_LEVELS
        )
        times.append(1e3 * (time.thread_time() - begin))
        pixels.append(new.astype(np.float64))
        seen.append(seen[-1] & (found[:, 0] > 0))
        before = after
    found_pixels = np.stack(pixels)
    return Follow(np.linalg.norm(found_pixels - truth, axis=2), np.stack(seen), found_pixels, np.array(times))


def summary(run: Follow, truth: Float[np.ndarray, "frames nodes 2"]) -> dict[str, Any]:
    """Figures of a run: errors of all nodes in the last frame, of the seen ones in all frames, time per frame."""
    wrong = run.error[run.seen]
    return {
        "nodes": len(truth[0]),
        "largest step px": float(np.linalg.norm(np.diff(truth, axis=0), axis=2).max()),
        "median px at the end": float(np.median(run.error[-1])),
        "95 % px at the end": float(np.quantile(run.error[-1], 0.95)),
        "kept": float(run.seen[-1].mean()),
        "seen over all frames": float(run.seen.mean()),
        "99.9 % px of seen": float(np.quantile(wrong, 0.999)),
        "worst px of seen": float(wrong.max()),
        "ms median": float(np.median(run.milliseconds[WARM_UP:])),
        "ms 95 %": float(np.quantile(run.milliseconds[WARM_UP:], 0.95)),
    }


def back_after_occlusion(run: Follow) -> float:
    """Share of nodes that are seen within 1 px three frames after the obstacle has gone."""
    frame = OCCLUDED[1] + RECOVERY
    return float((run.seen[frame] & (run.error[frame] <= BACK)).mean())


def follow_specimen(series: DicImages, options: TrackerOptions = DIC_OPTIONS) -> tuple[Follow, list[dict[str, Any]]]:
    """The tracker on real images against the referee: a run, and a row for each step of the load."""
    truth = np.concatenate([series.points[None], series.points + series.displacement])
    run = follow(list(series.images), truth, series.edges, options)
    rows = [
        {
            "step": step,
            "points": len(series.points),
            "displacement px": float(np.median(np.linalg.norm(series.displacement[step - 1], axis=1))),
            "seen": float(run.seen[step].mean()),
            "median px": float(np.median(run.error[step])),
            "95 % px": float(np.quantile(run.error[step], 0.95)),
            "worst px": float(run.error[step].max()),
        }
        for step in range(1, len(truth))
    ]
    return run, rows


def read_clip(folder: Path) -> tuple[list[UInt8[np.ndarray, "h w 3"]], Float[np.ndarray, "frames nodes 2"], Any]:
    """Pictures, exact nodes and edges of a clip of the virtual lab.

    Raises: DataError where the clip has no exact nodes or fewer pictures than those.
    """
    exact = folder / "pixels.npy"
    if not exact.is_file():
        raise DataError(f"{folder} has no pixels.npy; name a folder of clips that the virtual lab has made.")
    nodes = np.load(exact).astype(np.float64)
    source = folder / "frames" if (folder / "frames").is_dir() else folder / "video.mp4"
    images = [frame.image for frame in open_video(source)]
    if len(images) < len(nodes):
        raise DataError(f"{source} has {len(images)} pictures for {len(nodes)} frames of nodes; make the clip again.")
    return images[: len(nodes)], nodes.reshape(len(nodes), -1, 2), lattice_edges(nodes.shape[1], nodes.shape[2])
