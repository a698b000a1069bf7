"""Vision of glasses judged from the command line.

`python -m zsdt.evaluation.glass_vision_bench WEIGHTS OUT` judges trained weights on painted stills of looks and vessels
that training never saw; `--folder FOLDER` on pictures and masks that were rendered (or labelled) before, each by
itself; with `--video` on clips that are read in order with what is remembered of the glass, as the twin does.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import torch

from zsdt.errors import OptionError, ZsdtError
from zsdt.evaluation.glass_vision_report import (
    GlassVisionTable,
    judge_glass_videos,
    judge_glass_vision,
    milliseconds,
    verdicts,
)
from zsdt.evaluation.glass_vision_training import painted_glasses
from zsdt.evaluation.liquid_report import markdown_table
from zsdt.files import atomic_path
from zsdt.lab.styles import Pool
from zsdt.perception.glass_segmentation import GlassSegmenter, load_glass_segmenter
from zsdt.perception.glass_vision_data import LabelledGlasses, no_glasses, read_glass_folder
from zsdt.perception.segmentation import SegmentationBackend

FIRST_JUDGED = 5000  # seed of the first still to judge by; development looked at others


def judge_glass_weights(
    weights: str | Path,
    out: str | Path,
    data: LabelledGlasses,
    *,
    backend: SegmentationBackend = SegmentationBackend.eager,
    size: int | None = None,
    threads: Sequence[int] = (1, 2),
    about: str = "",
) -> GlassVisionTable:
    """Judges trained weights on labelled pictures and writes the report, and milliseconds against threads, to `out`."""

    def load() -> GlassSegmenter:
        return load_glass_segmenter(weights, backend, size)

    table = judge_glass_vision(load(), data, out, about)
    if threads:
        rows = [{"backend": backend.value, **row} for row in milliseconds(load, data, threads)]
        with atomic_path(Path(out) / "glass_vision_ms.json") as beside:
            beside.write_text(json.dumps(rows, indent=1))
        with (Path(out) / "glass_vision.md").open("a") as page:
            page.write(f"\nOne window, wall time against threads:\n\n{markdown_table(rows)}\n")
    return table


def judge_clips(
    weights: str | Path,
    out: str | Path,
    folders: Sequence[Path],
    every: int,
    *,
    backend: SegmentationBackend = SegmentationBackend.eager,
    size: int | None = None,
    about: str = "",
) -> GlassVisionTable:
    """Judges trained weights on clips that are read in order, see `judge_glass_videos`; writes the report to `out`.

    folders: clips with a mask for every picture. every: so many pictures lie between two that are judged.
    """
    clips = [every_of(folder, 1) for folder in folders]
    return judge_glass_videos(load_glass_segmenter(weights, backend, size), clips, every, out, about)


def every_of(folder: Path, step: int) -> LabelledGlasses:
    """Every so many pictures of a folder, named after it."""
    if step < 1:
        raise OptionError("--every must be at least 1.")
    data = read_glass_folder(folder)
    chosen = data.pick(range(0, len(data), step))
    return replace(chosen, names=[f"{folder.name}/{name}" for name in chosen.names])


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; the exit status, 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m zsdt.evaluation.glass_vision_bench", description=__doc__)
    parser.add_argument("weights", type=Path, help="folder with unet.pt and unet.json, or yolo.pt and yolo.json")
    parser.add_argument("out", type=Path, help="folder for the report")
    parser.add_argument("--folder", type=Path, nargs="+", help="pictures and masks, or clips of the lab, to judge by")
    parser.add_argument("--every", type=int, default=1, help="with --folder: every so many pictures")
    parser.add_argument("--video", action="store_true", help="the folders are clips, read in order, with a memory")
    parser.add_argument("--about", default="", help="a sentence on the pictures, for the report")
    parser.add_argument("--images", type=int, default=100, help="painted pictures, without --folder")
    parser.add_argument("--first", type=int, default=FIRST_JUDGED, help="seed of the first painted picture")
    parser.add_argument("--backend", type=SegmentationBackend, default=SegmentationBackend.eager)
    parser.add_argument("--size", type=int, help="working size of a window [px]; default: as trained")
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2], help="of the table of milliseconds")
    given = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    torch.set_num_threads(max(given.threads, default=1))
    if given.video and not given.folder:
        parser.error("--video needs the clips of --folder")
    try:
        if given.video:
            table = judge_clips(
                given.weights,
                given.out,
                given.folder,
                given.every,
                backend=given.backend,
                size=given.size,
                about=given.about,
            )
            return _told(table)
        if given.folder:
            data = sum((every_of(folder, given.every) for folder in given.folder), no_glasses())
        else:
            data = painted_glasses(given.first, given.images, Pool.unseen)
        table = judge_glass_weights(
            given.weights,
            given.out,
            data,
            backend=given.backend,
            size=given.size,
            threads=given.threads,
            about=given.about,
        )
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 2
    return _told(table)


def _told(table: GlassVisionTable) -> int:
    """Prints the figures; 1 where a target is missed."""
    shown = verdicts(table.summary)
    print(markdown_table(shown))
    print(markdown_table([{"figure": name, "value": value} for name, value in table.summary.items()]))
    return 0 if all(row["met"] == "yes" for row in shown) else 1


if __name__ == "__main__":
    sys.exit(main())
