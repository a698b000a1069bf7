"""How well the crossings of a grid are tracked: painted beams of the virtual lab and real images of a specimen.

`python -m zsdt.evaluation.tracking_report OUT [--seeds 0 1 2] [--clips FOLDER]` writes tracking.csv, .md, .png and
dic.csv, .md, .png below OUT and says whether the required figures are met (exit status 1 where not).
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from zsdt.errors import DataError, ZsdtError
from zsdt.evaluation.liquid_report import CaseResult, Verdict, write_case
from zsdt.evaluation.tracking_runs import (
    DIC_OPTIONS,
    Follow,
    back_after_occlusion,
    chain,
    follow,
    follow_specimen,
    read_clip,
    summary,
)
from zsdt.evaluation.tracking_scenes import DIFFICULTIES, Difficulty, SwingingBeam
from zsdt.interop.dic_images import DicImages, read_dic_images

FRAMES = 101
GOAL_MEDIAN, GOAL_MOST, GOAL_BACK, GOAL_DIC = 0.4, 2.0, 0.95, 0.05
JUDGED = ("light", "noise", "shadow")
SHOWN_FRAMES = {"occlusion": (45, 63), "fast": (20,), "shadow": (60,)}
COLOURS = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#D55E00", "#0072B2", "#CC79A7", "#777777")
SEEN, LOST = (0, 220, 0), (0, 0, 255)  # BGR


def tracking_case(seeds: Sequence[int], clips: Path | None) -> CaseResult:
    """Painted beams under every difficulty, and the clips of a folder where one is given."""
    rows: list[dict[str, Any]] = []
    curves: dict[str, list[np.ndarray]] = {d.name: [] for d in DIFFICULTIES}
    last: dict[str, list[np.ndarray]] = {d.name: [] for d in DIFFICULTIES}
    back: list[float] = []
    pictures: dict[str, np.ndarray] = {}
    for seed in seeds:
        beam = SwingingBeam(seed)
        for difficulty in DIFFICULTIES:
            images, truth, run = _painted_run(beam, difficulty)
            rows.append(_row(difficulty.name, f"painted {seed}", images, truth, run))
            curves[difficulty.name].append(run.error)
            last[difficulty.name].append(run.error[-1])
            if difficulty.occluded:
                back.append(back_after_occlusion(run))
            if seed == seeds[0]:
                for frame in SHOWN_FRAMES.get(difficulty.name, ()):
                    pictures[f"{difficulty.name}, frame {frame}"] = _marked(images[frame], run, frame)
    for folder in sorted(path.parent for path in clips.glob("*/pixels.npy")) if clips else []:
        images, truth, edges = read_clip(folder)
        rows.append(_row("clip", folder.name, images, truth, follow(images, truth, edges)))
    verdicts = [_accuracy(name, np.concatenate(last[name])) for name in JUDGED]
    worst = min(back)
    verdicts.append(
        Verdict(
            "nodes back within 1 px, 3 frames after an occlusion of 30", f"{100 * worst:.1f} % in the worst scene",
            f">= {100 * GOAL_BACK:.0f} %", worst >= GOAL_BACK,
        )
    )  # fmt: skip
    remarks = [
        "Errors against the painter's exact crossings; 'at the end' over all nodes, also those that were not seen. No "
        "prediction of a twin was given. Plain: OpenCV's pyramidal Lucas-Kanade from frame to frame, 21 px, 3 levels.",
        "Milliseconds are processor time of the one thread, grey conversion included, decoding of the video not.",
    ]
    return CaseResult("Tracking of grid crossings", rows, verdicts, remarks, _figure(curves, pictures))


def dic_case(series: DicImages) -> CaseResult:
    """Real images of an open-hole tension test against the referee's displacements."""
    run, rows = follow_specimen(series)
    median = float(np.median(run.error[1:]))
    verdict = Verdict(
        "median deviation from the referee on real images", f"{median:.4f} px", f"<= {GOAL_DIC} px", median <= GOAL_DIC
    )
    figure = Figure(figsize=(8, 4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 2))
    left.imshow(series.images[-1], cmap="gray")
    shown = left.scatter(*run.pixels[-1].T, c=run.error[-1], s=10, cmap="viridis", vmax=0.1)
    left.set_title("last step, deviation [px]")
    left.set_axis_off()
    figure.colorbar(shown, ax=left, shrink=0.7)
    for step in range(1, len(run.error)):
        right.plot(np.sort(run.error[step]), np.linspace(0, 1, run.error.shape[1]), label=f"step {step}")
    right.axvline(GOAL_DIC, color="0.5", linestyle=":")
    right.set(xscale="log", xlabel="deviation from the referee [px]", ylabel="share of points")
    right.legend(frameon=False)
    choice = f"window {DIC_OPTIONS.window} px, no mask"
    remarks = [f"The tracker of the beam with {choice}. The referee is another program (DICe, subsets of 27 px)."]
    return CaseResult("Tracking on real images", rows, [verdict], remarks, figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out", type=Path, help="folder for the results")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="painted beams")
    parser.add_argument("--clips", type=Path, help="folder of clips of the virtual lab")
    chosen = parser.parse_args(given)
    command = "python -m zsdt.evaluation.tracking_report " + shlex.join(given)
    cv2.setNumThreads(1)
    try:
        if chosen.clips is not None and not chosen.clips.is_dir():
            raise DataError(f"There is no folder {chosen.clips}; make clips with the virtual lab first.")
        results = {"dic": dic_case(read_dic_images()), "tracking": tracking_case(chosen.seeds, chosen.clips)}
        for name, result in results.items():
            write_case(chosen.out, name, command, result)
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 2
    verdicts = [verdict for result in results.values() for verdict in result.verdicts]
    for verdict in verdicts:
        print(verdict.line())
    return 0 if all(verdict.passed for verdict in verdicts) else 1


def _painted_run(beam: SwingingBeam, difficulty: Difficulty) -> tuple[list[np.ndarray], np.ndarray, Follow]:
    frames = list(beam.frames(difficulty, FRAMES))
    images, truth = [image for image, _ in frames], np.stack([nodes for _, nodes in frames])
    return images, truth, follow(images, truth, beam.edges, twin=difficulty.twin)


def _row(case: str, scene: str, images: list[np.ndarray], truth: np.ndarray, run: Follow) -> dict[str, Any]:
    plain = chain(images, truth)
    row: dict[str, Any] = {"case": case, "scene": scene} | summary(run, truth)
    row["back"] = back_after_occlusion(run) if case == "occlusion" else None
    row["plain median px"] = float(np.median(plain.error[-1]))
    row["plain 95 % px"] = float(np.quantile(plain.error[-1], 0.95))
    row["plain ms"] = float(np.median(plain.milliseconds))
    return row


def _accuracy(name: str, error: np.ndarray) -> Verdict:
    median, most = float(np.median(error)), float(np.quantile(error, 0.95))
    return Verdict(
        f"{name}: error after {FRAMES - 1} frames",
        f"median {median:.3f} px, 95 % {most:.2f} px",
        f"<= {GOAL_MEDIAN} and <= {GOAL_MOST} px",
        median <= GOAL_MEDIAN and most <= GOAL_MOST,
    )


def _marked(image: np.ndarray, run: Follow, frame: int) -> np.ndarray:
    """The picture with its nodes: green where seen, red where only expected."""
    marked = image.copy()
    for (u, v), seen in zip(np.rint(8 * run.pixels[frame]).astype(int), run.seen[frame], strict=True):
        cv2.circle(marked, (int(u), int(v)), 5 * 8, SEEN if seen else LOST, 2, cv2.LINE_AA, 3)
    return cv2.cvtColor(marked, cv2.COLOR_BGR2RGB)


def _figure(curves: dict[str, list[np.ndarray]], pictures: dict[str, np.ndarray]) -> Figure:
    figure = Figure(figsize=(12, 12), layout="constrained")
    grid = figure.add_gridspec(3, 2, height_ratios=(1.1, 1, 1))
    for column, (share, title) in enumerate(((0.5, "median"), (0.95, "95 %"))):
        axes = figure.add_subplot(grid[0, column])
        for (name, errors), colour in zip(curves.items(), COLOURS, strict=False):
            pooled = np.concatenate(errors, axis=1)
            axes.plot(np.quantile(pooled[1:], share, axis=1), label=name, color=colour)
        axes.axhline(GOAL_MEDIAN if column == 0 else GOAL_MOST, color="0.5", linestyle=":")
        axes.set(yscale="log", xlabel="frame", ylabel=f"{title} of the error [px]")
        if column == 0:
            axes.legend(frameon=False, ncols=4, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    for place, (title, picture) in enumerate(pictures.items()):
        axes = figure.add_subplot(grid[1 + place // 2, place % 2])
        axes.imshow(picture)
        axes.set_title(title + ": green seen, red expected")
        axes.set_axis_off()
    return figure


if __name__ == "__main__":
    sys.exit(main())
