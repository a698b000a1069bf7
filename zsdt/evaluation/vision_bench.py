"""Vision judged on the virtual lab, from the command line.

`python -m zsdt.evaluation.vision_bench WEIGHTS OUT` judges trained weights on stills in styles that training never saw;
with `--against-images 10 25 55 200` it trains anew on so many pictures instead and tells what each is worth.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import torch

from zsdt.errors import OptionError, ZsdtError
from zsdt.evaluation.liquid_report import markdown_table
from zsdt.evaluation.vision_report import VisionTable, judge_vision, verdicts
from zsdt.files import atomic_path
from zsdt.lab.stills import Still, painted_still
from zsdt.lab.styles import Pool
from zsdt.perception.segmentation import SegmentationBackend, load_segmenter
from zsdt.perception.vision_data import LabelledImages, labelled
from zsdt.perception.vision_train import VisionOptions, iou_against_images

FIRST_JUDGED = 5000  # seed of the first still to judge by; development looked at others


def stills(first: int, count: int, pool: Pool) -> Iterator[Still]:
    """Painted stills of the seeds from `first` on."""
    return (painted_still(seed, pool) for seed in range(first, first + count))


def lab_images(first: int, count: int, pool: Pool) -> LabelledImages:
    """The same as labelled pictures."""
    return labelled(((still.image, still.grid_mask) for still in stills(first, count, pool)), f"lab {pool.value}")


def judge_weights(
    weights: str | Path,
    out: str | Path,
    *,
    images: int = 100,
    first: int = FIRST_JUDGED,
    backend: SegmentationBackend = SegmentationBackend.eager,
) -> VisionTable:
    """Judges trained weights on `images` stills of unseen styles; writes the report into `out`."""
    return judge_vision(load_segmenter(weights, backend), stills(first, images, Pool.unseen), out)


def worth_of_images(
    counts: Sequence[int], options: VisionOptions, out: str | Path, *, judged: int = 40
) -> list[dict[str, Any]]:
    """IoU on unseen styles against the number of training pictures; writes CSV and Markdown into `out`."""
    data = lab_images(0, max(counts), Pool.train)
    rows = iou_against_images(data, lab_images(FIRST_JUDGED, judged, Pool.unseen), counts, options, out)
    with atomic_path(Path(out) / "iou_against_images.md") as beside:
        beside.write_text(
            f"# IoU against the number of training pictures\n\n{options.steps} steps each, {judged} stills of unseen "
            f"styles; 12 % of the training pictures are held out.\n\n{markdown_table(rows)}\n"
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; the exit status, 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m zsdt.evaluation.vision_bench", description=__doc__)
    parser.add_argument("weights", type=Path, nargs="?", help="folder with unet.pt and unet.json")
    parser.add_argument("out", type=Path, help="folder for the report")
    parser.add_argument("--images", type=int, default=100)
    parser.add_argument("--first", type=int, default=FIRST_JUDGED, help="seed of the first still")
    parser.add_argument("--backend", type=SegmentationBackend, default=SegmentationBackend.eager)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--against-images", type=int, nargs="+", metavar="N")
    parser.add_argument("--steps", type=int, default=500, help="of each training with --against-images")
    given = parser.parse_args(arguments)
    torch.set_num_threads(given.threads)
    cv2.setNumThreads(given.threads)
    try:
        if given.against_images:
            options = VisionOptions(steps=given.steps)
            print(markdown_table(worth_of_images(given.against_images, options, given.out, judged=given.images)))
            return 0
        if given.weights is None:
            raise OptionError("Name the folder of the weights to judge, and then one for the report.")
        table = judge_weights(given.weights, given.out, images=given.images, first=given.first, backend=given.backend)
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 2
    shown = verdicts(table.summary)
    print(markdown_table(shown))
    print(markdown_table([{"figure": name, "value": value} for name, value in table.summary.items()]))
    return 0 if all(row["met"] == "yes" for row in shown) else 1


if __name__ == "__main__":
    sys.exit(main())
